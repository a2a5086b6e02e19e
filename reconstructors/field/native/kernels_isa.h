// Compiled once for each instruction set with its own flags (CMakeLists.txt) and its own namespace PCB_ISA, like the
// search loops of pcbench/native/points and for the same reasons.
#pragma once
#include "kernels.h"

#define PCB_SPACE pcbench::field::PCB_ISA
#include "common/floats.h"

#include "rays.h"
#include "rows.h"

namespace pcbench::field::PCB_ISA {

#define PCB_QUOTE_(name) #name
#define PCB_QUOTE(name) PCB_QUOTE_(name)
extern const Kernels kernels = {PCB_QUOTE(PCB_ISA), trace, pull_back, scatter, smooth, descend};

}  // namespace pcbench::field::PCB_ISA
