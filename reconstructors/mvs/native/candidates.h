// Planes at sixteen pixels that are compared with the sources, several at each: as many of them at a time as there are
// lanes, whatever pixel they are of. Included once for each instruction set, see kernels_isa.h.
#pragma once
#include "score.h"

namespace pcbench::mvs::PCB_ISA {

// The numbers that an array holds for some pixels, `width` for each. Pixels times width may exceed 2^31; the distance
// of these pixels from the group, a few rows at most, does not.
class Records {
public:
    Records(const float* array, int width, const Group& group, Ints pixels)
        : nearby_(array + static_cast<int64_t>(group.pixel[0]) * width),
          offsets_((pixels - Ints(group.pixel[0])) * Ints(width)) {}
    Floats operator[](int column) const { return gather(nearby_ + column, offsets_); }

private:
    const float* nearby_;  // the record of the group's first pixel
    Ints offsets_;
};

inline Planes planes_at(const State& state, const Group& group, Ints pixels) {
    const Records planes(state.plane, 4, group, pixels);
    return {planes[0], planes[1], planes[2], planes[3]};
}

inline Planes chosen(Mask which, const Planes& yes, const Planes& no) {
    return {select(which, yes.depth, no.depth), select(which, yes.nx, no.nx), select(which, yes.ny, no.ny),
            select(which, yes.nz, no.nz)};
}

// Falls from 1 at no cost to 0.
inline Floats trust(Floats cost) {
    const Floats one = Floats(1.0f), d = one + cost * cost * Floats(1.0f / (2 * 0.3f * 0.3f));
    return select(cost < Floats(kWorst), one / (d * d), Floats(0.0f));
}

class Candidates {
public:
    static constexpr int kParts = 8, kMost = kParts * kLanes;

    explicit Candidates(int sources) : sources_(sources) {}

    // A part: planes of the sixteen pixels, of which those count that are asked for.
    void add(const Planes& planes, Mask which) {
        const int from = parts_++ * kLanes;
        store(depth_ + from, planes.depth), store(nx_ + from, planes.nx);
        store(ny_ + from, planes.ny), store(nz_ + from, planes.nz);
        for (int s = 0; s < sources_; ++s) store(cost_[s] + from, Floats(kWorst));
        for (uint32_t left = bits(which); left; left &= left - 1) at_[count_++] = from + __builtin_ctz(left);
    }

    void score(const Problem& problem, const Patches& patches) {
        for (int first = 0; first < count_; first += kLanes) {
            const int count = count_ - first < kLanes ? count_ - first : kLanes;
            int32_t* at = at_ + first;
            for (int l = count; l < kLanes; ++l) at[l] = at[count - 1];
            const Ints from = load(at);
            const Planes planes = {gather(depth_, from), gather(nx_, from), gather(ny_, from), gather(nz_, from)};
            const Patches here = patches.permuted(from & Ints(kLanes - 1));
            for (int s = 0; s < sources_; ++s) {
                float cost[kLanes];
                store(cost, PCB_ISA::score(problem, problem.sources[s], here, planes));
                for (int l = 0; l < count; ++l) cost_[s][at[l]] = cost[l];
            }
        }
    }

    // Of a part's planes in a source; the worst for those that were not asked for.
    Floats cost(int part, int source) const { return load(cost_[source] + part * kLanes); }

private:
    int sources_, parts_ = 0, count_ = 0;
    int32_t at_[kMost + kLanes];  // of those that were asked for: number of the part times the lanes, and the lane
    float depth_[kMost], nx_[kMost], ny_[kMost], nz_[kMost];
    float cost_[kMaxSources][kMost];
};

}  // namespace pcbench::mvs::PCB_ISA
