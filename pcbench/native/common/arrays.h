// Array types of the modules' arguments: C-contiguous, on the CPU, with one element type. Results are written into
// arrays of the caller.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>

namespace nb = nanobind;

template <typename T, typename... Shape>
using In = nb::ndarray<const T, nb::c_contig, nb::device::cpu, Shape...>;
template <typename T, typename... Shape>
using Out = nb::ndarray<T, nb::c_contig, nb::device::cpu, Shape...>;
using Points = In<double, nb::shape<-1, 3>>;
using Column = In<double, nb::shape<-1>>;
using Indices = In<int64_t, nb::shape<-1>>;

inline void check(bool holds, const char* message) {
    if (!holds) throw nb::value_error(message);
}
