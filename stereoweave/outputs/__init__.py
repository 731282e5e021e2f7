"""What is made of an estimate: maps, reports, point clouds, measurements."""
