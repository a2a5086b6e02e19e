// Memory that each thread of a search reuses for one query after the other.
#pragma once
#include <cstddef>
#include <vector>

#include <omp.h>

#include "common/block.h"

namespace pcbench {

// At least `bytes` for each thread, on separate pages.
class ThreadScratch {
public:
    explicit ThreadScratch(size_t bytes) {
        const size_t stride = (bytes + 4095) / 4096 * 4096 / sizeof(double);
        const size_t threads = static_cast<size_t>(omp_get_max_threads());
        memory_ = allocate<double>(stride * threads);
        for (size_t t = 0; t < threads; ++t) threads_.push_back(memory_.get() + t * stride);
    }

    double* const* data() const { return threads_.data(); }

private:
    Block<double> memory_;
    std::vector<double*> threads_;
};

}  // namespace pcbench
