// Compiled once for each instruction set with its own flags (CMakeLists.txt) and its own namespace PCB_ISA, like the
// search loops of pcbench/native/points and for the same reasons.
#pragma once
#include "kernels.h"

#define PCB_SPACE pcbench::splat::PCB_ISA
#define PCB_FN inline
#include "common/floats.h"

namespace PCB_SPACE {
#include "maths.h"
}

#include "adam.h"
#include "blend.h"
#include "loss.h"
#include "project.h"

namespace pcbench::splat::PCB_ISA {

#define PCB_QUOTE_(name) #name
#define PCB_QUOTE(name) PCB_QUOTE_(name)
extern const Kernels kernels = {PCB_QUOTE(PCB_ISA),     project_group, cover,         blend_tile, blend_tile_gradient,
                                project_group_gradient, similarity,    loss_gradient, adam};

}  // namespace pcbench::splat::PCB_ISA
