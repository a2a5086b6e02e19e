// Exact order statistics of one array without sorting it: a histogram of the leading bits of all values, then selection
// within the few bins that hold the requested ranks.
#pragma once
#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <vector>

namespace pcbench {

// Leading bits of a double, as an integer with the order of the values: sign, exponent and, of 16 bits, four bits of
// the mantissa.
inline size_t leading_bits(double value, unsigned count) {
    uint64_t bits;
    std::memcpy(&bits, &value, sizeof bits);
    // A larger magnitude of a negative value is a smaller value.
    const uint64_t flipped = bits >> 63 ? ~uint64_t{0} : uint64_t{1} << 63;
    return static_cast<size_t>((bits ^ flipped) >> (64 - count));
}

// Writes the values of the ascending `ranks` among [first, last), which is reordered. `offset` is the rank of *first.
inline void select_ranks(double* first, double* last, size_t offset, const size_t* ranks, size_t rank_count,
                         double* found) {
    if (rank_count == 0) return;
    const size_t middle = rank_count / 2;
    double* const nth = first + (ranks[middle] - offset);
    std::nth_element(first, nth, last);
    size_t low = middle, high = middle + 1;
    while (low > 0 && ranks[low - 1] == ranks[middle]) --low;
    while (high < rank_count && ranks[high] == ranks[middle]) ++high;
    std::fill(found + low, found + high, *nth);
    select_ranks(first, nth, offset, ranks, low, found);
    select_ranks(nth + 1, last, ranks[middle] + 1, ranks + high, rank_count - high, found + high);
}

// Writes the values of the ascending `ranks` (0: the smallest) among value(0), ..., value(count - 1). Returns false,
// and writes nothing, if one of them is NaN.
template <typename Value>
bool order_statistics(size_t count, Value value, const size_t* ranks, size_t rank_count, double* found) {
    constexpr size_t kFewValues = 1 << 14;  // of which a long histogram would take most of the time
    const unsigned bits = count < kFewValues ? 12 : 16;
    std::vector<size_t> counts(size_t{1} << bits);
    bool has_nan = false;
    for (size_t i = 0; i < count; ++i) {
        const double v = value(i);
        has_nan |= v != v;
        ++counts[leading_bits(v, bits)];
    }
    if (has_nan) return false;

    struct Slot {  // a bin that holds the ranks [first_rank, last_rank)
        size_t offset, begin, end, first_rank, last_rank;
    };
    std::vector<Slot> slots;
    std::vector<uint32_t> slot_of_bin(counts.size(), 0);  // counted from 1; 0: no requested rank
    size_t below = 0, gathered = 0;
    for (size_t bin = 0, rank = 0; rank < rank_count; below += counts[bin++]) {
        const size_t first_rank = rank;
        while (rank < rank_count && ranks[rank] < below + counts[bin]) ++rank;
        if (rank == first_rank) continue;
        slots.push_back({below, gathered, gathered + counts[bin], first_rank, rank});
        slot_of_bin[bin] = static_cast<uint32_t>(slots.size());
        gathered += counts[bin];
    }

    // Values of other bins are all written to one place behind the others: a branch would often be mispredicted.
    std::vector<double> buffer(gathered + 1);
    std::vector<size_t> next{gathered};
    for (const Slot& slot : slots) next.push_back(slot.begin);
    for (size_t i = 0; i < count; ++i) {
        const double v = value(i);
        const uint32_t slot = slot_of_bin[leading_bits(v, bits)];
        buffer[next[slot]] = v;
        next[slot] += slot != 0;
    }
    for (const Slot& slot : slots)
        select_ranks(buffer.data() + slot.begin, buffer.data() + slot.end, slot.offset, ranks + slot.first_rank,
                     slot.last_rank - slot.first_rank, found + slot.first_rank);
    return true;
}

// Median of values, at least one, which are reordered: the mean of the two middle ones if their number is even.
inline double median(double* first, double* last) {
    double* const upper = first + (last - first) / 2;
    std::nth_element(first, upper, last);
    return (last - first) % 2 ? *upper : 0.5 * (*std::max_element(first, upper) + *upper);
}

}  // namespace pcbench
