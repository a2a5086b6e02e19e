#define PCB_ISA avx512
#include "kernels_isa.h"
