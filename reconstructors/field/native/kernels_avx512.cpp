#if !defined(__AVX512F__) || !defined(__AVX512DQ__)
#error "kernels_avx512.cpp must be compiled with -mavx512f -mavx512dq: see CMakeLists.txt"
#endif
#define PCB_ISA avx512
#include "kernels_isa.h"
