// Registers the triangle tree; `module.cpp` calls it.
#pragma once
#include <nanobind/nanobind.h>

namespace nb = nanobind;

void bind_mesh(nb::module_& m);
