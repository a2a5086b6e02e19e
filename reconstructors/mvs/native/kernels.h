// The loops that exist once for each instruction set, and the choice between them.
#pragma once
#include "problem.h"

namespace pcbench::mvs {

struct Kernels {
    const char* name;
    bool (*begin)(const Problem&, State&, Interrupt&);
    bool (*sweep)(const Problem&, State&, int number, Interrupt&);
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
