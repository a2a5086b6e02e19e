// Candidate planes at sixteen pixels, several per pixel, scored against the sources. Candidates are compacted: each
// vector of lanes is filled with candidates of any pixel. Included once for each instruction set, see kernels_isa.h.
#pragma once
#include "score.h"

namespace pcbench::mvs::PCB_ISA {

// Gathers records of an array, `width` floats per pixel, at sixteen pixels. Pixel index times width may exceed 2^31,
// but the offset from the group's first pixel, a few rows at most, does not.
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

inline Planes select_planes(Mask which, const Planes& yes, const Planes& no) {
    return {select(which, yes.depth, no.depth), select(which, yes.nx, no.nx), select(which, yes.ny, no.ny),
            select(which, yes.nz, no.nz)};
}

// Weight of a view or plane: falls from 1 at zero cost towards 0.
inline Floats cost_weight(Floats cost) {
    const Floats one = Floats(1.0f), d = one + cost * cost * Floats(1.0f / (2 * 0.3f * 0.3f));
    return select(cost < Floats(kMaxCost), one / (d * d), Floats(0.0f));
}

class Candidates {
public:
    static constexpr int kParts = 8, kMaxPlanes = kParts * kLanes;

    explicit Candidates(int sources) : sources_(sources) {}

    // Add one plane for each of the sixteen pixels as the next part; only those in the mask are scored.
    void add(const Planes& planes, Mask which) {
        const int from = parts_++ * kLanes;
        store(depth_ + from, planes.depth), store(nx_ + from, planes.nx);
        store(ny_ + from, planes.ny), store(nz_ + from, planes.nz);
        for (int s = 0; s < sources_; ++s) store(cost_[s] + from, Floats(kMaxCost));
        for (uint32_t left = bits(which); left; left &= left - 1) at_[count_++] = from + __builtin_ctz(left);
    }

    void score(const Problem& problem, const Patches& patches) {
        for (int first = 0; first < count_; first += kLanes) {
            const int count = count_ - first < kLanes ? count_ - first : kLanes;
            int32_t* at = at_ + first;
            for (int l = count; l < kLanes; ++l) at[l] = at[count - 1];
            const Ints from = load(at);
            const Planes planes = {gather(depth_, from), gather(nx_, from), gather(ny_, from), gather(nz_, from)};
            const Patches here = patches.permute(from & Ints(kLanes - 1));
            for (int s = 0; s < sources_; ++s) {
                float cost[kLanes];
                store(cost, PCB_ISA::score(problem, problem.sources[s], here, planes));
                for (int l = 0; l < count; ++l) cost_[s][at[l]] = cost[l];
            }
        }
    }

    // The costs of a part's planes in a source; the maximum for planes outside the part's mask.
    Floats cost(int part, int source) const { return load(cost_[source] + part * kLanes); }

private:
    int sources_, parts_ = 0, count_ = 0;
    int32_t at_[kMaxPlanes + kLanes];  // position of each scored plane: part * kLanes + lane
    float depth_[kMaxPlanes], nx_[kMaxPlanes], ny_[kMaxPlanes], nz_[kMaxPlanes];
    float cost_[kMaxSources][kMaxPlanes];
};

}  // namespace pcbench::mvs::PCB_ISA
