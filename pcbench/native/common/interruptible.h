// Runs long loops without the GIL, and stops them on Ctrl-C.
#pragma once
#include <nanobind/nanobind.h>

#include "common/interrupt.h"

namespace pcbench {

// Returns true if Ctrl-C was pressed; KeyboardInterrupt is then set and must be thrown.
inline bool python_interrupts() {
    nanobind::gil_scoped_acquire acquire;
    return PyErr_CheckSignals() != 0;
}

// Runs loop(interrupt) without the GIL. Throws KeyboardInterrupt if Ctrl-C stopped the loop.
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
