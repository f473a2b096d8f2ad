"""Pure geometry on triangle meshes: topology, geometry, proximity, quality."""
