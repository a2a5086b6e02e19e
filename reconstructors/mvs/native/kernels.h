// Function table of the loops that are compiled once for each instruction set.
#pragma once
#include "problem.h"

namespace pcbench::mvs {

struct Kernels {
    const char* name;
    bool (*initialize)(const Problem&, State&, Interrupt&);
    bool (*sweep)(const Problem&, State&, int sweep_index, Interrupt&);
};

namespace baseline {
extern const Kernels kernels;
}
#ifdef PCB_X86
namespace avx2 {
extern const Kernels kernels;
}
namespace avx512 {
extern const Kernels kernels;
}
#endif

}  // namespace pcbench::mvs
