#define PCB_ISA avx512
#include "points/kernels_isa.h"
