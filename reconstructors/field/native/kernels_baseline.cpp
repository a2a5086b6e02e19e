#define PCB_ISA baseline
#include "kernels_isa.h"
