#include <cstdlib>
#include <stdexcept>
#include <string>

#include "points/kernels.h"

namespace pcbench {
namespace {

struct Choice {
    const Kernels* kernels;
    bool runs_here;
};

const Kernels& choose() {
#ifdef PCB_X86
    const bool bits =
        __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2") && __builtin_cpu_supports("popcnt");
#endif
    const Choice choices[] = {
#ifdef PCB_X86
        {&avx512::kernels, bits && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                               __builtin_cpu_supports("avx512vl")},
        {&avx2::kernels, bits && __builtin_cpu_supports("avx2")},
#endif
        {&baseline::kernels, true},
    };
    const char* wanted = std::getenv("PCBENCH_ISA");
    if (wanted == nullptr || *wanted == '\0') {
        for (const Choice& choice : choices)
            if (choice.runs_here) return *choice.kernels;
    }
    std::string here;
    for (const Choice& choice : choices) {
        if (!choice.runs_here) continue;
        if (std::string(wanted) == choice.kernels->name) return *choice.kernels;
        here += (here.empty() ? "" : ", ") + std::string(choice.kernels->name);
    }
    throw std::runtime_error("PCBENCH_ISA: expected one that this machine runs (" + here + "), got '" + wanted + "'");
}

}  // namespace

const Kernels& kernels() {
    static const Kernels& chosen = choose();
    return chosen;
}

}  // namespace pcbench
