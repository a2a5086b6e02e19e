"""A voxel radiance field after Plenoxels (Fridovich-Keil et al. 2022), trained on the CPU, and a reconstructor."""
