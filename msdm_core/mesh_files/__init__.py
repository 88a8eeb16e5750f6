"""Reading and writing meshes and surfaces."""
