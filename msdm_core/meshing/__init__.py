"""Making tetrahedral meshes from blocks, surfaces and label images."""
