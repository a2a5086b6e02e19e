// Registers the loops over points that need no tree; `module.cpp` calls it.
#pragma once
#include <nanobind/nanobind.h>

void bind_loops(nanobind::module_& m);
