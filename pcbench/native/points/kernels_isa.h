// Compiled once for each instruction set with its own flags (CMakeLists.txt) and its own namespace PCB_ISA: the linker
// must never find two copies of one inline function and keep the one that this machine cannot run. For the same reason
// these headers take no function from the standard library but those of <cmath>, nor one that is inline elsewhere:
// tests/native/test_instruction_sets.py looks at what each unit leaves to the linker.
#pragma once
#include "points/kernels.h"
#include "points/knearest.h"
#include "points/nearest.h"
#include "points/planes.h"
#include "points/regions.h"
#include "points/tree_build.h"

namespace pcbench::PCB_ISA {

#define PCB_QUOTE_(name) #name
#define PCB_QUOTE(name) PCB_QUOTE_(name)
extern const Kernels kernels = {PCB_QUOTE(PCB_ISA), arrange, bound, nearest, knearest, in_balls, in_cylinders, planes,
                                PlaneScratch::bytes};

}  // namespace pcbench::PCB_ISA
