// Choice of the instruction set at run time: the widest that this machine supports, or the one named by the environment
// variable PCBENCH_ISA.
#pragma once
#include <cstdlib>
#include <initializer_list>
#include <stdexcept>
#include <string>

namespace pcbench {

inline bool is_supported(const std::string& isa) {
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

// Chooses from `choices`, widest first. Throws std::runtime_error if the requested instruction set is not supported.
template <typename Kernels>
const Kernels& choose_kernels(std::initializer_list<const Kernels*> choices) {
    const char* requested = std::getenv("PCBENCH_ISA");
    std::string supported;
    for (const Kernels* choice : choices) {
        if (!is_supported(choice->name)) continue;
        if (requested == nullptr || *requested == '\0' || std::string(requested) == choice->name) return *choice;
        supported += (supported.empty() ? "" : ", ") + std::string(choice->name);
    }
    throw std::runtime_error("PCBENCH_ISA: expected an instruction set that this machine supports (" + supported +
                             "), got '" + requested + "'");
}

}  // namespace pcbench
