#include "common/choose_kernels.h"
#include "points/kernels.h"

namespace pcbench {

const Kernels& kernels() {
    static const Kernels& chosen = choose_kernels<Kernels>({
#ifdef PCB_X86
        &avx512::kernels,
        &avx2::kernels,
#endif
        &baseline::kernels,
    });
    return chosen;
}

}  // namespace pcbench
