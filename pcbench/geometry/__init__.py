"""The types everything else is made of: arrays, clouds, meshes, cameras, transforms, and what is computed of them."""
