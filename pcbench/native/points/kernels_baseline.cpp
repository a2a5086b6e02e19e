#define PCB_ISA baseline
#include "points/kernels_isa.h"
