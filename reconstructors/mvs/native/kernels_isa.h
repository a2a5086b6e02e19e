// Compiled once for each instruction set with its own flags (CMakeLists.txt) and namespace PCB_ISA, like the search
// loops of pcbench/native/points and for the same reasons.
#pragma once
#include "kernels.h"

#define PCB_SPACE pcbench::mvs::PCB_ISA
#include "sweep.h"

namespace pcbench::mvs::PCB_ISA {

#define PCB_QUOTE_(name) #name
#define PCB_QUOTE(name) PCB_QUOTE_(name)
extern const Kernels kernels = {PCB_QUOTE(PCB_ISA), initialize, sweep};

}  // namespace pcbench::mvs::PCB_ISA
