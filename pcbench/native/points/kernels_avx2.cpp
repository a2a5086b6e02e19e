#define PCB_ISA avx2
#include "kernels_isa.h"
