// Long loops on behalf of Python: without the GIL, and ended by Ctrl-C.
#pragma once
#include <nanobind/nanobind.h>

#include "common/interrupt.h"

namespace pcbench {

// True when Ctrl-C has raised KeyboardInterrupt, which then waits to be thrown.
inline bool python_interrupts() {
    nanobind::gil_scoped_acquire acquire;
    return PyErr_CheckSignals() != 0;
}

// Runs loop(interrupt) without the GIL. When Ctrl-C ends it early, KeyboardInterrupt is raised here.
template <typename Loop>
void interruptible(Loop loop) {
    Interrupt interrupt(python_interrupts);
    {
        nanobind::gil_scoped_release release;
        loop(interrupt);
    }
    if (interrupt.stopped()) throw nanobind::python_error();
}

}  // namespace pcbench
