"""Triangle meshes as places: today's scenes, drawn by this package's renderer."""
