// Compiled once per instruction set, with its own flags (CMakeLists.txt) and its own namespace PCB_ISA. The linker must
// not merge two copies of an inline function into one that this machine cannot run. For the same reason these headers
// use no function of the standard library except those of <cmath>, and no inline functions of other headers.
// tests/native/test_instruction_sets.py checks the weak symbols of each unit.
#pragma once
#include "pairs/polynomials.h"
#include "points/kernels.h"
#include "points/knearest.h"
#include "points/nearest.h"
#include "points/planes.h"
#include "points/regions.h"
#include "points/tree_build.h"

namespace pcbench::PCB_ISA {

#define PCB_QUOTE_(name) #name
#define PCB_QUOTE(name) PCB_QUOTE_(name)
extern const Kernels kernels = {PCB_QUOTE(PCB_ISA),
                                sort_into_leaves,
                                build_upper_levels,
                                nearest,
                                follow,
                                knearest,
                                knearest_bytes,
                                in_balls,
                                in_cylinders,
                                count_near,
                                planes,
                                GroupPlanes::bytes,
                                normal_equations,
                                whole_normal_equations};

}  // namespace pcbench::PCB_ISA
