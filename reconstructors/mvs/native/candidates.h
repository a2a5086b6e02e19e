// Candidate planes at sixteen pixels, several per pixel, scored against the sources. Candidates are compacted: each
// vector of lanes is filled with candidates of any pixel. Included once for each instruction set, see kernels_isa.h.
#pragma once
#include "score.h"

namespace pcbench::mvs::PCB_ISA {

// Gathers records of an array, `width` floats per pixel, at sixteen pixels. Pixel index times width may exceed 2^31,
// but the offset from the group's first pixel, a few rows at most, does not.
class Records {
public:
    template <int kEvery>
    Records(const float* array, int width, const Group<kEvery>& group, Ints pixels)
        : nearby_(array + static_cast<int64_t>(group.pixel[0]) * width),
          offsets_((pixels - Ints(group.pixel[0])) * Ints(width)) {}
    Floats operator[](int column) const { return gather(nearby_ + column, offsets_); }

private:
    const float* nearby_;  // the record of the group's first pixel
    Ints offsets_;
};

template <int kEvery>
inline Planes planes_at(const State& state, const Group<kEvery>& group, Ints pixels) {
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

    // Set a part's planes, one for each of the sixteen pixels, and the costs to assume in sources where they are not
    // scored.
    void set(int part, const Planes& planes, const Floats* costs) {
        const int from = part * kLanes;
        store(depth_ + from, planes.depth), store(nx_ + from, planes.nx);
        store(ny_ + from, planes.ny), store(nz_ + from, planes.nz);
        store(sum_ + from, Floats(0.0f));
        for (int s = 0; s < sources_; ++s) store(cost_[s] + from, costs[s]);
    }

    // Queue the planes of a part at the pixels in the mask for the next scoring.
    void queue(int part, Mask which) {
        for (uint32_t left = bits(which); left; left &= left - 1)
            queue_[queued_++] = part * kLanes + __builtin_ctz(left);
    }

    // Score the queued planes in all sources.
    template <int kEvery>
    void score(const Problem& problem, const Patches<kEvery>& patches) {
        score_in(0, sources_, problem, patches, queue_, queued_);
        queued_ = 0;
    }

    // Score the queued planes in the sources that have weight at their pixels, one source after the other. A plane
    // whose weighted sum of costs has reached the limit of its pixel is not scored in the remaining sources.
    template <int kEvery>
    void score_below(Floats limits, const Floats* weights, const Problem& problem, const Patches<kEvery>& patches) {
        float limit[kLanes], weight[kLanes];
        store(limit, limits);
        for (int s = 0; s < sources_; ++s) {
            store(weight, weights[s]);
            int32_t weighted[kMaxPlanes + kLanes];
            int kept = 0, count = 0;
            for (int i = 0; i < queued_; ++i) {
                const int32_t plane = queue_[i], lane = plane % kLanes;
                const bool below = sum_[plane] < limit[lane];
                queue_[kept] = plane, kept += below;
                weighted[count] = plane, count += below & (0 < weight[lane]);
            }
            queued_ = kept;
            score_in(s, s + 1, problem, patches, weighted, count);
            for (int i = 0; i < count; ++i) sum_[weighted[i]] += weight[weighted[i] % kLanes] * cost_[s][weighted[i]];
        }
        queued_ = 0;
    }

    // The weighted sums of the costs of a part's planes after `score_below`.
    Floats sum(int part) const { return load(sum_ + part * kLanes); }

    // The costs of a part's planes in a source.
    Floats cost(int part, int source) const { return load(cost_[source] + part * kLanes); }

private:
    // Score planes in a range of sources. The list must have room for sixteen more: the last vector is filled up.
    template <int kEvery>
    void score_in(int begin, int end, const Problem& problem, const Patches<kEvery>& patches, int32_t* planes,
                  int count) {
        for (int first = 0; first < count; first += kLanes) {
            const int used = count - first < kLanes ? count - first : kLanes;
            int32_t* at = planes + first;
            for (int l = used; l < kLanes; ++l) at[l] = at[used - 1];
            const Ints from = load(at);
            const Planes here = {gather(depth_, from), gather(nx_, from), gather(ny_, from), gather(nz_, from)};
            const Patches<kEvery> patches_here = patches.permute(from & Ints(kLanes - 1));
            for (int s = begin; s < end; ++s) {
                float cost[kLanes];
                store(cost, PCB_ISA::score(problem, problem.sources[s], patches_here, here));
                for (int l = 0; l < used; ++l) cost_[s][at[l]] = cost[l];
            }
        }
    }

    int sources_, queued_ = 0;
    int32_t queue_[kMaxPlanes + kLanes];  // positions of planes: part * kLanes + lane
    float depth_[kMaxPlanes], nx_[kMaxPlanes], ny_[kMaxPlanes], nz_[kMaxPlanes];
    float sum_[kMaxPlanes], cost_[kMaxSources][kMaxPlanes];
};

}  // namespace pcbench::mvs::PCB_ISA
