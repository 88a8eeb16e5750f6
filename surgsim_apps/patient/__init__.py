"""Scenes of patients' organs from label images, surfaces and tets: mesh, materials, supports, report."""
