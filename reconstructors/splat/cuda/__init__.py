"""The rasterizer on CUDA.

Its kernels ship as source and are compiled at first use by NVRTC: neither nvcc nor a compiler is needed, and any torch
will do (`pip install 'pcbench[cuda]'`). Importing this needs neither torch nor CUDA.

Compiled for sm_80, sm_90 and sm_120 and emulated on the CPU by the tests; not run on a GPU.
"""

from reconstructors.splat.cuda.rasterizer import CudaRasterizer as Rasterizer
from reconstructors.splat.cuda.training import adam, image_loss, morton_order

__all__ = ["Rasterizer", "adam", "image_loss", "morton_order"]
