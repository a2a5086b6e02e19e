#ifndef __AVX2__
#error "kernels_avx2.cpp must be compiled with -mavx2: see CMakeLists.txt"
#endif
#define PCB_ISA avx2
#include "kernels_isa.h"
