"""Outputs of an estimate: maps, reports, point clouds, meshes and measurements."""
