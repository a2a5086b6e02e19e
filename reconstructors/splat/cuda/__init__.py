"""The rasterizer on CUDA.

Its kernels ship as source and are compiled at first use by NVRTC. Neither nvcc nor a C++ compiler is needed, and any
torch with CUDA works (`pip install 'pcbench[cuda]'`). Importing this module needs neither torch nor CUDA.

The tests compile the kernels for sm_80, sm_90 and sm_120 and emulate them on the CPU. They have not been run on a GPU.
"""

from reconstructors.splat.cuda.rasterizer import CudaRasterizer as Rasterizer
from reconstructors.splat.cuda.training import adam, image_loss, morton_order

__all__ = ["Rasterizer", "adam", "image_loss", "morton_order"]
