#include "common/interrupt.h"

#include <omp.h>

namespace pcbench {

Interrupt::Interrupt(bool (*poll)()) : poll_(poll), last_(std::chrono::steady_clock::now()) {}

bool Interrupt::stopped() const { return stop_.load(std::memory_order_relaxed); }

bool Interrupt::requested() {
    if (omp_get_thread_num() == 0 && !stopped()) {
        const auto now = std::chrono::steady_clock::now();
        if (now - last_ > std::chrono::milliseconds(50)) {
            last_ = now;
            if (poll_()) stop_.store(true, std::memory_order_relaxed);
        }
    }
    return stopped();
}

}  // namespace pcbench
