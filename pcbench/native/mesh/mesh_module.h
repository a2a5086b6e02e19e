// Registers the triangle tree; `module.cpp` calls it.
#pragma once
#include <nanobind/nanobind.h>

void bind_mesh(nanobind::module_& m);
