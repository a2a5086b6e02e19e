#define PCB_ISA avx2
#include "points/kernels_isa.h"
