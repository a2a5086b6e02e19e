// Ctrl-C during long loops: the calling thread asks Python now and then, the others look at a flag.
#pragma once
#include <atomic>
#include <chrono>

#include <omp.h>

namespace pcbench {

class Interrupt {
public:
    // `asks` returns true when the work shall stop; it is only ever called on the thread that made this object.
    explicit Interrupt(bool (*asks)()) : asks_(asks), last_(std::chrono::steady_clock::now()) {}

    bool requested() {
        if (omp_get_thread_num() == 0) {
            const auto now = std::chrono::steady_clock::now();
            if (now - last_ > std::chrono::milliseconds(50)) {
                last_ = now;
                if (!stopped() && asks_()) stop_.store(true, std::memory_order_relaxed);
            }
        }
        return stopped();
    }

    bool stopped() const { return stop_.load(std::memory_order_relaxed); }

private:
    bool (*asks_)();
    std::chrono::steady_clock::time_point last_;
    std::atomic<bool> stop_{false};
};

}  // namespace pcbench
