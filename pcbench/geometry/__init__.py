"""Basic geometry: arrays, clouds, meshes, cameras, transforms, regions, and nearest-neighbour search."""
