// Which of the loops that were compiled once for each instruction set are run: the widest that this machine has, or
// those that the environment's PCBENCH_ISA names.
#pragma once
#include <cstdlib>
#include <initializer_list>
#include <stdexcept>
#include <string>

namespace pcbench {

inline bool runs_here(const std::string& isa) {
#ifdef PCB_X86
    const bool bits =
        __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2") && __builtin_cpu_supports("popcnt");
    if (isa == "avx512")
        return bits && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
               __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
    if (isa == "avx2") return bits && __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#endif
    return isa == "baseline";
}

// `choices`: the widest first; each has a name. Throws std::runtime_error when the one that is wanted cannot run.
template <typename Kernels>
const Kernels& choose_kernels(std::initializer_list<const Kernels*> choices) {
    const char* wanted = std::getenv("PCBENCH_ISA");
    std::string here;
    for (const Kernels* choice : choices) {
        if (!runs_here(choice->name)) continue;
        if (wanted == nullptr || *wanted == '\0' || std::string(wanted) == choice->name) return *choice;
        here += (here.empty() ? "" : ", ") + std::string(choice->name);
    }
    throw std::runtime_error("PCBENCH_ISA: expected one that this machine runs (" + here + "), got '" + wanted + "'");
}

}  // namespace pcbench
