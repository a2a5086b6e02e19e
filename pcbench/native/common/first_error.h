// Exceptions inside OpenMP regions. An exception that leaves its thread would terminate the process.
#pragma once
#include <atomic>
#include <exception>

namespace pcbench {

// Stores the first exception of a region until all threads have left it. The remaining work is then skipped.
class FirstError {
public:
    // The C++ library allocates a thread's exception state on first use and terminates the process if that fails. Here
    // every thread allocates it before the region uses up memory.
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

    // Throws the stored exception, if any. Call it after the region.
    void rethrow() const {
        if (error_) std::rethrow_exception(error_);
    }

private:
    std::atomic<int> unfinished_{0};  // always 0; its use keeps the compiler from removing the calls above
    std::atomic<bool> failed_{false};
    std::exception_ptr error_;  // written once, read after the barrier that ends the region
};

}  // namespace pcbench
