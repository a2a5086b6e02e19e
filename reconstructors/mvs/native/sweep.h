// PatchMatch: planes pass from pixel to pixel of the other colour of a chessboard and are varied at random, and what
// explains the sources better is kept (Galliani et al. 2015; the eight regions and the choice of views: Xu and Tao
// 2019). Sixteen pixels at a time. Included once for each instruction set, see kernels_isa.h.
#pragma once
#include "candidates.h"
#include "regions.h"

namespace pcbench::mvs::PCB_ISA {

// Numbers that depend on what they are for alone, not on the order of the work.
class Random {
public:
    Random(uint32_t seed, Ints pixels, int sweep)
        : state_(Ints(static_cast<int32_t>(seed)) ^ mixed(pixels ^ mixed(Ints(sweep)))) {}
    Floats unit() {  // 0 to 1
        state_ = state_ * Ints(747796405) + Ints(static_cast<int32_t>(2891336453u));
        return floats(shifted_right<8>(mixed(state_))) * Floats(1.0f / 16777216.0f);
    }
    Floats symmetric() { return Floats(2.0f) * unit() - Floats(1.0f); }

private:
    static Ints mixed(Ints v) {
        v = v ^ shifted_right<16>(v);
        v = v * Ints(0x7feb352d);
        v = v ^ shifted_right<15>(v);
        v = v * Ints(static_cast<int32_t>(0x846ca68bu));
        return v ^ shifted_right<16>(v);
    }
    Ints state_;
};

// The search at sixteen pixels.
class Search {
public:
    Search(const Problem& problem, State& state, int y, int first)
        : problem_(problem), state_(state), group_(problem, y, first), sources_(problem.source_count) {
        plane_ = planes_at(state, group_, load(group_.pixel));
    }

    // The costs of the planes there are; pixels without one get one at random.
    void begin() {
        const Floats none = Floats(0.0f);
        Random random(problem_.seed, load(group_.pixel), -1);
        const Planes made = any_normal(random, {random_depth(random), none, none, none});
        plane_ = chosen(sensible(plane_), plane_, made);
        plane_.depth = select(group_.valid, plane_.depth, none);
        Floats total = none, weights = none;
        for (int s = 0; s < sources_; ++s) {
            view_costs_[s] = score(problem_, problem_.sources[s], group_.patches, plane_);
            const Floats weight = trust(view_costs_[s]);
            total = total + weight * view_costs_[s], weights = weights + weight;
        }
        cost_ = select(group_.valid & (none < weights), total / weights, Floats(kWorst));
        write();
    }

    void improve(int number) {
        if (!bits(group_.valid)) return;
        const Records costs(state_.view_costs, sources_, group_, load(group_.pixel));
        for (int s = 0; s < sources_; ++s) view_costs_[s] = costs[s];
        spread();
        vary(number);
        write();
    }

private:
    // Takes over the planes of neighbours that explain a pixel better, after choosing the views that count there.
    void spread() {
        Candidates all(sources_);
        Mask there[kRegions], mine[kRegions], fresh[kRegions], as[kRegions][kRegions];
        Planes planes[kRegions];
        for (int r = 0; r < kRegions; ++r) {
            const Neighbor best = best_of_region(problem_, state_, group_, r);
            planes[r] = planes_at(state_, group_, best.pixel);
            planes[r].depth = depth_here(planes[r], best);
            there[r] = best.found & sensible(planes[r]);
            mine[r] = there[r] & same(planes[r], plane_);
            fresh[r] = there[r] & ~mine[r];
            for (int earlier = 0; earlier < r; ++earlier) {
                as[r][earlier] = fresh[r] & fresh[earlier] & same(planes[r], planes[earlier]);
                fresh[r] = fresh[r] & ~as[r][earlier];
            }
            all.add(planes[r], fresh[r]);
        }
        all.score(problem_, group_.patches);
        Floats costs[kMaxSources][kRegions];
        for (int s = 0; s < sources_; ++s)
            for (int r = 0; r < kRegions; ++r) {
                costs[s][r] = select(mine[r], view_costs_[s], all.cost(r, s));
                for (int earlier = 0; earlier < r; ++earlier)
                    costs[s][r] = select(as[r][earlier], costs[s][earlier], costs[s][r]);
            }
        choose_views(there, costs);
        cost_ = mean(view_costs_);
        for (int r = 0; r < kRegions; ++r) take_if_better(planes[r], fresh[r], all, r);
    }

    void vary(int number) {
        // From pixels to fractions of one, and from wide turns to small ones.
        float reach = 2.0f / problem_.pixels_per_depth, tilt = 0.5f;
        for (int i = 0; i < number; ++i) reach *= 0.5f, tilt *= 0.6f;
        Random random(problem_.seed, load(group_.pixel), number);
        for (int round = 0; round < 3; ++round) {
            Planes plane = plane_;
            if (round != 1)
                plane.depth = Floats(1.0f) / (Floats(1.0f) / plane.depth + random.symmetric() * Floats(reach));
            if (round != 0) plane = turned(random, tilt, plane);
            Candidates one(sources_);
            const Mask which = group_.valid & sensible(plane);
            one.add(plane, which);
            one.score(problem_, group_.patches);
            take_if_better(plane, which, one, 0);
        }
        const Mask lost = group_.valid & (Floats(kLost) < cost_);
        if (!bits(lost)) return;
        Candidates all(sources_);
        Planes planes[2];
        Mask which[2];
        for (int i = 0; i < 2; ++i) {
            planes[i] = plane_;
            if (i == 0) planes[i].depth = random_depth(random);
            planes[i] = any_normal(random, planes[i]);
            which[i] = lost & sensible(planes[i]);
            all.add(planes[i], which[i]);
        }
        all.score(problem_, group_.patches);
        for (int i = 0; i < 2; ++i) take_if_better(planes[i], which[i], all, i);
    }

    // A view counts as far as the neighbours' planes find it to agree; one that most of them find to disagree is taken
    // to see something else. Where no view is left each counts as far as the best plane says.
    void choose_views(const Mask* there, const Floats (*costs)[kRegions]) {
        const Floats zero = Floats(0.0f), one = Floats(1.0f);
        Floats total = zero;
        for (int s = 0; s < sources_; ++s) {
            Floats good = zero, bad = zero, sum = zero;
            for (int r = 0; r < kRegions; ++r) {
                const Mask agrees = there[r] & (costs[s][r] < Floats(kGood));
                good = good + select(agrees, one, zero);
                sum = sum + select(agrees, trust(costs[s][r]), zero);
                bad = bad + select(there[r] & (Floats(kBad) < costs[s][r]), one, zero);
            }
            weights_[s] = select((Floats(2.5f) < good) & (bad < Floats(2.5f)), sum / good, zero);
            total = total + weights_[s];
        }
        const Mask some = zero < total;
        if (!bits(~some)) return;
        for (int s = 0; s < sources_; ++s) {
            Floats least = view_costs_[s];
            for (int r = 0; r < kRegions; ++r) least = select(there[r], lesser(costs[s][r], least), least);
            weights_[s] = select(some, weights_[s], trust(least));
        }
    }

    Floats mean(const Floats* costs) const {
        const Floats zero = Floats(0.0f);
        Floats sum = zero, total = zero;
        for (int s = 0; s < sources_; ++s) sum = sum + weights_[s] * costs[s], total = total + weights_[s];
        return select(zero < total, sum / total, Floats(kWorst));
    }

    // Planes of the candidates' part of that number, of pixels for which they were scored.
    void take_if_better(const Planes& planes, Mask which, const Candidates& all, int part) {
        Floats costs[kMaxSources];
        for (int s = 0; s < sources_; ++s) costs[s] = all.cost(part, s);
        const Floats cost = mean(costs);
        const Mask better = which & (cost < cost_);
        plane_ = chosen(better, planes, plane_);
        cost_ = select(better, cost, cost_);
        for (int s = 0; s < sources_; ++s) view_costs_[s] = select(better, costs[s], view_costs_[s]);
    }

    void write() {
        float depth[kLanes], nx[kLanes], ny[kLanes], nz[kLanes], cost[kLanes], each[kMaxSources][kLanes];
        store(depth, plane_.depth), store(nx, plane_.nx), store(ny, plane_.ny), store(nz, plane_.nz);
        store(cost, cost_);
        for (int s = 0; s < sources_; ++s) store(each[s], view_costs_[s]);
        for (int l = 0; l < group_.count; ++l) {
            const int64_t at = group_.pixel[l];
            float* p = state_.plane + 4 * at;
            p[0] = depth[l], p[1] = nx[l], p[2] = ny[l], p[3] = nz[l];
            state_.cost[at] = cost[l];
            for (int s = 0; s < sources_; ++s) state_.view_costs[at * sources_ + s] = each[s][l];
        }
    }

    // Where planes of other pixels meet the rays of these.
    Floats depth_here(const Planes& planes, const Neighbor& from) const {
        const Patches& at = group_.patches;
        const Floats x = (at.x + from.dx - Floats(problem_.cx)) / Floats(problem_.fx);
        const Floats y = (at.y + from.dy - Floats(problem_.cy)) / Floats(problem_.fy);
        return planes.depth * (dot(planes, x, y) / dot(planes, at.ray_x, at.ray_y));
    }

    // In the range, and not seen from behind or along itself.
    Mask sensible(const Planes& planes) const {
        const Floats facing = dot(planes, group_.patches.ray_x, group_.patches.ray_y);
        return (Floats(problem_.nearest) <= planes.depth) & (planes.depth <= Floats(problem_.farthest)) &
               (facing < Floats(-0.1f) * ray_length());
    }

    Floats ray_length() const {
        const Floats x = group_.patches.ray_x, y = group_.patches.ray_y;
        return root((x * x + y * y) + Floats(1.0f));
    }

    // Too little apart to tell by the images.
    Mask same(const Planes& a, const Planes& b) const {
        const Floats one = Floats(1.0f), zero = Floats(0.0f);
        const Floats moved = (one / a.depth - one / b.depth) * Floats(problem_.pixels_per_depth);
        return (greater(moved, zero - moved) < Floats(kSameMove)) & (Floats(kSameCosine) < dot_of_normals(a, b));
    }

    static Floats dot_of_normals(const Planes& a, const Planes& b) { return (a.nx * b.nx + a.ny * b.ny) + a.nz * b.nz; }

    Floats random_depth(Random& random) const {
        const float near = 1.0f / problem_.nearest, far = 1.0f / problem_.farthest;
        return Floats(1.0f) / (Floats(far) + random.unit() * Floats(near - far));
    }

    // Any direction within 60 degrees of the ray back to the camera, about evenly.
    Planes any_normal(Random& random, Planes planes) const {
        const Floats by = Floats(-1.0f) / ray_length();
        planes.nx = group_.patches.ray_x * by, planes.ny = group_.patches.ray_y * by, planes.nz = by;
        return turned(random, 1.5f, planes);
    }

    static Planes turned(Random& random, float by, Planes planes) {
        const Floats nx = planes.nx + Floats(by) * random.symmetric(), ny = planes.ny + Floats(by) * random.symmetric(),
                     nz = planes.nz + Floats(by) * random.symmetric();
        const Floats length = root((nx * nx + ny * ny) + nz * nz);
        return chosen(Floats(1e-3f) < length, {planes.depth, nx / length, ny / length, nz / length}, planes);
    }

    static constexpr float kGood = 0.6f, kBad = 1.2f, kLost = 0.4f;
    static constexpr float kSameMove = 0.05f, kSameCosine = 0.999f;

    const Problem& problem_;
    State& state_;
    Group group_;
    int sources_;
    Planes plane_;
    Floats cost_;
    Floats view_costs_[kMaxSources], weights_[kMaxSources];
};

// One colour after the other. Number: of the sweep, from 0, after which the steps of the variation are halved.
inline bool sweep(const Problem& problem, State& state, int number, Interrupt& interrupt) {
    for (int colour = 0; colour < 2; ++colour) {
        lay_beside(problem, state, 1 - colour);
#pragma omp parallel for schedule(dynamic, 4)
        for (int y = 0; y < problem.height; ++y) {
            if (interrupt.requested()) continue;
            for (int first = (y + colour) & 1; first < problem.width; first += 2 * kLanes)
                Search(problem, state, y, first).improve(number);
        }
    }
    return !interrupt.stopped();
}

inline bool begin(const Problem& problem, State& state, Interrupt& interrupt) {
#pragma omp parallel for schedule(dynamic, 4)
    for (int y = 0; y < problem.height; ++y) {
        if (interrupt.requested()) continue;
        for (int colour = 0; colour < 2; ++colour)
            for (int first = colour; first < problem.width; first += 2 * kLanes)
                Search(problem, state, y, first).begin();
    }
    return !interrupt.stopped();
}

}  // namespace pcbench::mvs::PCB_ISA
