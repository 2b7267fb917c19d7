"""Studies of the cutting physics: verification, steps, meshes, speed."""
