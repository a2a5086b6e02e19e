// Exceptions inside OpenMP regions: one that leaves its thread would end the process.
#pragma once
#include <atomic>
#include <exception>

namespace pcbench {

// Keeps the first exception of a region until all threads have left it. After one, what is left of the work is skipped.
class FirstError {
public:
    // The C++ library's memory of a thread's exceptions is taken when the thread first needs it, and a thread for which
    // there is none then ends the process: all threads take it here, before the region takes its own.
    FirstError() {
#pragma omp parallel
        unfinished_ += std::uncaught_exceptions();
    }

    template <typename Work>
    void guard(Work work) noexcept {
        if (failed_.load(std::memory_order_relaxed)) return;
        try {
            work();
        } catch (...) {
            if (!failed_.exchange(true)) error_ = std::current_exception();
        }
    }

    // Throws what was kept. To be called after the region.
    void rethrow() const {
        if (error_) std::rethrow_exception(error_);
    }

private:
    std::atomic<int> unfinished_{0};  // exceptions that threads came with: none, but the compiler must ask
    std::atomic<bool> failed_{false};
    std::exception_ptr error_;  // written once, read after the barrier that ends the region
};

}  // namespace pcbench
