// The k nearest points of one query: a sorted list for few, a buffer that is sorted at the end for many.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include "points/group.h"

namespace pcbench::PCB_ISA {

// The nearest points found so far, sorted by (distance, row) and stored in the query's row of the result.
class NearestK {
public:
    NearestK(const Tree& tree, const double* query, size_t k, double* squared, int64_t* rows)
        : tree_(tree), query_(query), box_(box_of_point(query)), k_(k), squared_(squared), rows_(rows) {}

    // For k = 1. Any point is valid; a near one gives a low first bound, which prunes more.
    void start(int64_t hint) {
        const double* p = tree_.points + 3 * hint;
        const double dx = query_[0] - p[0], dy = query_[1] - p[1], dz = query_[2] - p[2];
        insert((dx * dx + dy * dy) + dz * dz, static_cast<double>(hint));
    }

    Vector squared_gaps(const Node& node) const { return pcbench::PCB_ISA::squared_gaps(node, box_); }
    double bound() const { return count_ < k_ ? kUnbounded : squared_[k_ - 1]; }
    uint32_t last_tie() const { return count_ < k_ ? UINT32_MAX : static_cast<uint32_t>(rows_[k_ - 1]); }

    void leaf(uint32_t id, const Node&, int) {
        const Leaf& leaf = tree_.leaves[id];
        const Vector d = squared_length(splat(query_[0]) - load(leaf.x), splat(query_[1]) - load(leaf.y),
                                        splat(query_[2]) - load(leaf.z));
        alignas(64) double squared[kLanes];
        store(squared, d);
        for (unsigned near = bits(d <= splat(bound())); near; near &= near - 1) {
            const int i = __builtin_ctz(near);
            insert(squared[i], leaf.row[i]);
        }
    }

private:
    void insert(double squared, double row) {
        if (count_ == k_) {
            if (!is_before(squared, row, squared_[k_ - 1], static_cast<double>(rows_[k_ - 1]))) return;
        } else {
            ++count_;
        }
        size_t at = count_ - 1;
        for (; at > 0 && is_before(squared, row, squared_[at - 1], static_cast<double>(rows_[at - 1])); --at)
            squared_[at] = squared_[at - 1], rows_[at] = rows_[at - 1];
        squared_[at] = squared, rows_[at] = static_cast<int64_t>(row);
    }

    const Tree& tree_;
    const double* query_;
    Box box_;
    size_t k_, count_ = 0;
    double* squared_;
    int64_t* rows_;
};

// Points of one query, in memory that is reused.
class NeighborBuffer {
public:
    static size_t bytes(size_t capacity) { return capacity * (4 * sizeof(double) + 2 * sizeof(uint32_t)); }

    NeighborBuffer(size_t capacity, double* memory)
        : capacity_(capacity),
          squared_(memory),
          rows_(squared_ + capacity),
          unsorted_squared_(rows_ + capacity),
          unsorted_rows_(unsorted_squared_ + capacity),
          buckets_(reinterpret_cast<uint32_t*>(unsorted_rows_ + capacity)),
          ends_(buckets_ + capacity) {}

    size_t count() const { return count_; }
    bool has_room(size_t points) const { return count_ + points <= capacity_; }
    double squared(size_t i) const { return squared_[i]; }
    double row(size_t i) const { return rows_[i]; }

    void append(double squared, double row) {
        squared_[count_] = squared, rows_[count_] = row;
        ++count_;
    }

    void clear() { count_ = 0; }
    void keep_first(size_t count) { count_ = count; }

    // Sorts by (distance, row). The points of a surface are spread about evenly over the squared distances, so that
    // buckets of equal width hold few of them, and few moves remain.
    void sort() {
        constexpr double kLeastWidth = 1e-290;  // reciprocals of lower values may overflow
        double lowest = kUnbounded, highest = 0.0;
        for (size_t i = 0; i < count_; ++i) {
            lowest = squared_[i] < lowest ? squared_[i] : lowest;
            highest = squared_[i] > highest ? squared_[i] : highest;
        }
        const double width = highest - lowest;
        const double scale = width > kLeastWidth ? static_cast<double>(count_ - 1) / width : 0.0;
        for (size_t b = 0; b < count_; ++b) ends_[b] = 0;
        for (size_t i = 0; i < count_; ++i) {
            buckets_[i] = static_cast<uint32_t>((squared_[i] - lowest) * scale);
            ++ends_[buckets_[i]];
            unsorted_squared_[i] = squared_[i], unsorted_rows_[i] = rows_[i];
        }
        uint32_t end = 0;
        for (size_t b = 0; b < count_; ++b) ends_[b] = end += ends_[b];
        for (size_t i = 0; i < count_; ++i) {
            const uint32_t at = --ends_[buckets_[i]];
            squared_[at] = unsorted_squared_[i], rows_[at] = unsorted_rows_[i];
        }
        for (size_t i = 1; i < count_; ++i) {
            const double s = squared_[i], r = rows_[i];
            size_t at = i;
            for (; at > 0 && is_before(s, r, squared_[at - 1], rows_[at - 1]); --at)
                squared_[at] = squared_[at - 1], rows_[at] = rows_[at - 1];
            squared_[at] = s, rows_[at] = r;
        }
    }

    // Writes distances and rows of the first k points.
    void write(size_t k, double* distances, int64_t* rows) const {
        size_t i = 0;
        for (; i + kLanes <= k; i += kLanes) store(distances + i, sqrt(load(squared_ + i)));
        for (; i < k; ++i) distances[i] = std::sqrt(squared_[i]);
        for (i = 0; i < k; ++i) rows[i] = static_cast<int64_t>(rows_[i]);
    }

private:
    size_t capacity_, count_ = 0;
    double *squared_, *rows_;
    double *unsorted_squared_, *unsorted_rows_;
    uint32_t *buckets_, *ends_;
};

// Collects all points within a limit, which is lowered when the buffer is full.
class NearestMany {
public:
    static size_t capacity(size_t k) { return 2 * k + 4 * kFanout; }

    // Only points within the squared distance `limit` are collected.
    NearestMany(const Tree& tree, const double* query, size_t k, double limit, NeighborBuffer& buffer)
        : tree_(tree), query_(query), box_(box_of_point(query)), k_(k), buffer_(buffer), limit_(limit) {
        buffer_.clear();
    }

    Vector squared_gaps(const Node& node) const { return pcbench::PCB_ISA::squared_gaps(node, box_); }
    double bound() const { return limit_; }
    uint32_t last_tie() const { return static_cast<uint32_t>(last_row_); }

    void leaf(uint32_t id, const Node&, int) {
        if (!buffer_.has_room(kFanout)) keep_nearest();
        const Leaf& leaf = tree_.leaves[id];
        const Vector d = squared_length(splat(query_[0]) - load(leaf.x), splat(query_[1]) - load(leaf.y),
                                        splat(query_[2]) - load(leaf.z));
        alignas(64) double squared[kLanes];
        store(squared, d);
        const Mask tied = (d == splat(limit_)) & (load(leaf.row) <= splat(last_row_));
        for (unsigned near = bits((d < splat(limit_)) | tied); near; near &= near - 1) {
            const int i = __builtin_ctz(near);
            buffer_.append(squared[i], leaf.row[i]);
        }
    }

private:
    void keep_nearest() {
        buffer_.sort();
        buffer_.keep_first(k_);
        limit_ = buffer_.squared(k_ - 1), last_row_ = buffer_.row(k_ - 1);
    }

    const Tree& tree_;
    const double* query_;
    Box box_;
    size_t k_;
    NeighborBuffer& buffer_;
    double limit_, last_row_ = kNoRow;  // those of the k-th point, once the buffer was full
};

}  // namespace pcbench::PCB_ISA
