"""From a scene to pictures, depth and normals."""
