// PatchMatch: planes propagate between the two colours of a chessboard and are perturbed at random; planes of lower
// cost are kept (Galliani et al. 2015; regions and view weights: Xu and Tao 2019). Sixteen pixels at a time. Included
// once for each instruction set, see kernels_isa.h.
#pragma once
#include "candidates.h"
#include "regions.h"

namespace pcbench::mvs::PCB_ISA {

// Counter-based random numbers keyed by (seed, pixel, sweep): they do not depend on the order of the work.
class Random {
public:
    Random(uint32_t seed, Ints pixels, int sweep)
        : state_(Ints(static_cast<int32_t>(seed)) ^ hash(pixels ^ hash(Ints(sweep)))) {}
    Floats unit() {  // 0 to 1
        state_ = state_ * Ints(747796405) + Ints(static_cast<int32_t>(2891336453u));
        return to_floats(shift_right<8>(hash(state_))) * Floats(1.0f / 16777216.0f);
    }
    Floats symmetric() { return Floats(2.0f) * unit() - Floats(1.0f); }

private:
    static Ints hash(Ints v) {
        v = v ^ shift_right<16>(v);
        v = v * Ints(0x7feb352d);
        v = v ^ shift_right<15>(v);
        v = v * Ints(static_cast<int32_t>(0x846ca68bu));
        return v ^ shift_right<16>(v);
    }
    Ints state_;
};

// The search at a group of sixteen pixels, with every kEvery-th texel of their patches.
template <int kEvery>
class Search {
public:
    Search(const Problem& problem, State& state, int y, int first)
        : problem_(problem), state_(state), group_(problem, y, first), sources_(problem.source_count) {
        plane_ = planes_at(state, group_, load(group_.pixel));
    }

    // Score the initial planes; pixels without a valid one get a random one.
    void initialize() {
        const Floats none = Floats(0.0f);
        Random random(problem_.seed, load(group_.pixel), -1);
        const Planes random_planes = random_normal(random, {random_depth(random), none, none, none});
        plane_ = select_planes(is_valid(plane_), plane_, random_planes);
        plane_.depth = select(group_.valid, plane_.depth, none);
        Floats total = none, weights = none;
        for (int s = 0; s < sources_; ++s) {
            view_costs_[s] = score(problem_, problem_.sources[s], group_.patches, plane_);
            const Floats weight = cost_weight(view_costs_[s]);
            total = total + weight * view_costs_[s], weights = weights + weight;
        }
        cost_ = select(group_.valid & (none < weights), total / weights, Floats(kMaxCost));
        write();
    }

    void improve(int sweep_index) {
        if (!bits(group_.valid)) return;
        const Records costs(state_.view_costs, sources_, group_, load(group_.pixel));
        for (int s = 0; s < sources_; ++s) view_costs_[s] = costs[s];
        propagate();
        perturb(sweep_index);
        cost_ = select(Floats(0.0f) < total_weight_, sum_ / total_weight_, Floats(kMaxCost));
        write();
    }

private:
    // Weight the views, then adopt planes of neighbours that have a lower cost. The neighbours of least cost vote for
    // the views, and their planes are scored in all. The others are scored only as far as they can win.
    void propagate() {
        Candidates candidates(sources_);
        Mask exists[kRegions], is_new[kRegions], votes[kRegions], equals[kRegions][kRegions];
        Planes planes[kRegions];
        Floats neighbor_costs[kRegions];
        for (int r = 0; r < kRegions; ++r) {
            const Neighbor best = best_of_region(problem_, state_, group_, r);
            neighbor_costs[r] = best.cost;
            planes[r] = planes_at(state_, group_, best.pixel);
            planes[r].depth = depth_on_rays(planes[r], best);
            exists[r] = best.exists & is_valid(planes[r]);
            is_new[r] = exists[r] & ~are_similar(planes[r], plane_);
            for (int earlier = 0; earlier < r; ++earlier) {
                equals[r][earlier] = is_new[r] & is_new[earlier] & are_similar(planes[r], planes[earlier]);
                is_new[r] = is_new[r] & ~equals[r][earlier];
            }
            candidates.set(r, planes[r], view_costs_);
        }
        for (int r = 0; r < kRegions; ++r) {
            votes[r] = exists[r] & (rank_of(neighbor_costs, r) < Floats(kVotes));
            candidates.queue(r, is_new[r] & votes[r]);
        }
        candidates.score(problem_, group_.patches);
        Floats costs[kMaxSources][kRegions];
        for (int s = 0; s < sources_; ++s)
            for (int r = 0; r < kRegions; ++r) {
                costs[s][r] = candidates.cost(r, s);  // that of the present plane if it is the same
                for (int earlier = 0; earlier < r; ++earlier)
                    costs[s][r] = select(equals[r][earlier], costs[s][earlier], costs[s][r]);
            }
        // A plane that equals one that was not scored has no vote.
        for (int r = 0; r < kRegions; ++r)
            for (int earlier = 0; earlier < r; ++earlier) votes[r] = votes[r] & ~(equals[r][earlier] & ~votes[earlier]);
        weight_views(votes, costs);
        sum_ = weighted_sum(view_costs_);
        for (int r = 0; r < kRegions; ++r) {
            Floats each[kMaxSources];
            for (int s = 0; s < sources_; ++s) each[s] = costs[s][r];
            adopt(is_new[r] & votes[r], planes[r], weighted_sum(each), candidates, r);
            candidates.queue(r, is_new[r] & ~votes[r]);
        }
        candidates.score_below(sum_, weights_, problem_, group_.patches);
        for (int r = 0; r < kRegions; ++r) adopt(is_new[r] & ~votes[r], planes[r], candidates.sum(r), candidates, r);
    }

    // Rank of a cost among those of the neighbours, the least first; equal costs keep their order.
    static Floats rank_of(const Floats* costs, int number) {
        const Floats zero = Floats(0.0f), one = Floats(1.0f);
        Floats rank = zero;
        for (int r = 0; r < kRegions; ++r)
            if (r != number)
                rank = rank + select(r < number ? costs[r] <= costs[number] : costs[r] < costs[number], one, zero);
        return rank;
    }

    // Try perturbed planes; pixels whose cost is high also try random ones.
    void perturb(int sweep_index) {
        // Steps shrink with the sweep: depths from two pixels to fractions of one, normals from wide turns to small
        // ones.
        float depth_step = 2.0f / problem_.pixels_per_depth, normal_step = 0.5f;
        for (int i = 0; i < sweep_index; ++i) depth_step *= 0.5f, normal_step *= 0.6f;
        constexpr int kPerturbed = 3, kTrials = 5;
        const Mask poor = group_.valid & (Floats(kRestartCost) * total_weight_ < sum_);
        const int trials = bits(poor) ? kTrials : kPerturbed;
        Random random(problem_.seed, load(group_.pixel), sweep_index);
        Candidates candidates(sources_);
        Planes planes[kTrials];
        Mask which[kTrials];
        for (int i = 0; i < trials; ++i) {
            planes[i] = plane_;
            if (i == 0 || i == 2)
                planes[i].depth =
                    Floats(1.0f) / (Floats(1.0f) / plane_.depth + random.symmetric() * Floats(depth_step));
            if (i == 1 || i == 2) planes[i] = perturb_normal(random, normal_step, planes[i]);
            if (i == kPerturbed) planes[i].depth = random_depth(random);
            if (i >= kPerturbed) planes[i] = random_normal(random, planes[i]);
            which[i] = (i < kPerturbed ? group_.valid : poor) & is_valid(planes[i]);
            candidates.set(i, planes[i], view_costs_);
            candidates.queue(i, which[i]);
        }
        candidates.score_below(sum_, weights_, problem_, group_.patches);
        for (int i = 0; i < trials; ++i) adopt(which[i], planes[i], candidates.sum(i), candidates, i);
    }

    // Weight each view by how well the voting planes agree in it, and zero if two disagree or fewer than two agree: the
    // view is occluded. If no view is left, weight each by the cost of its best plane.
    void weight_views(const Mask* votes, const Floats (*costs)[kRegions]) {
        const Floats zero = Floats(0.0f), one = Floats(1.0f);
        Floats total = zero;
        for (int s = 0; s < sources_; ++s) {
            Floats good = zero, bad = zero, sum = zero;
            for (int r = 0; r < kRegions; ++r) {
                const Mask agrees = votes[r] & (costs[s][r] < Floats(kGoodCost));
                good = good + select(agrees, one, zero);
                sum = sum + select(agrees, cost_weight(costs[s][r]), zero);
                bad = bad + select(votes[r] & (Floats(kBadCost) < costs[s][r]), one, zero);
            }
            weights_[s] = select((Floats(1.5f) < good) & (bad < Floats(1.5f)), sum / good, zero);
            total = total + weights_[s];
        }
        total_weight_ = total;
        const Mask any_view = zero < total;
        if (!bits(~any_view)) return;
        total_weight_ = zero;
        for (int s = 0; s < sources_; ++s) {
            Floats least = view_costs_[s];
            for (int r = 0; r < kRegions; ++r) least = select(votes[r], lesser(costs[s][r], least), least);
            weights_[s] = select(any_view, weights_[s], cost_weight(least));
            total_weight_ = total_weight_ + weights_[s];
        }
    }

    Floats weighted_sum(const Floats* costs) const {
        Floats sum = Floats(0.0f);
        for (int s = 0; s < sources_; ++s) sum = sum + weights_[s] * costs[s];
        return sum;
    }

    // Adopt the planes of a part where the weighted sum of their costs is less; `which` are the pixels where it is
    // known.
    void adopt(Mask which, const Planes& planes, Floats sum, const Candidates& candidates, int part) {
        const Mask better = which & (sum < sum_);
        plane_ = select_planes(better, planes, plane_);
        sum_ = select(better, sum, sum_);
        for (int s = 0; s < sources_; ++s) view_costs_[s] = select(better, candidates.cost(part, s), view_costs_[s]);
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

    // Depths at which planes of other pixels intersect the rays of these pixels.
    Floats depth_on_rays(const Planes& planes, const Neighbor& from) const {
        const auto& at = group_.patches;
        const Floats x = (at.x + from.dx - Floats(problem_.cx)) / Floats(problem_.fx);
        const Floats y = (at.y + from.dy - Floats(problem_.cy)) / Floats(problem_.fy);
        return planes.depth * (dot(planes, x, y) / dot(planes, at.ray_x, at.ray_y));
    }

    // Whether planes are in the depth range and face the camera at less than about 84 degrees.
    Mask is_valid(const Planes& planes) const {
        const Floats facing = dot(planes, group_.patches.ray_x, group_.patches.ray_y);
        return (Floats(problem_.nearest) <= planes.depth) & (planes.depth <= Floats(problem_.farthest)) &
               (facing < Floats(-0.1f) * ray_length());
    }

    Floats ray_length() const {
        const Floats x = group_.patches.ray_x, y = group_.patches.ray_y;
        return root((x * x + y * y) + Floats(1.0f));
    }

    // Whether two planes are too similar for the images to distinguish them.
    Mask are_similar(const Planes& a, const Planes& b) const {
        const Floats one = Floats(1.0f), zero = Floats(0.0f);
        const Floats moved = (one / a.depth - one / b.depth) * Floats(problem_.pixels_per_depth);
        return (greater(moved, zero - moved) < Floats(kSimilarDisplacementPx)) &
               (Floats(kSimilarCosine) < dot_of_normals(a, b));
    }

    static Floats dot_of_normals(const Planes& a, const Planes& b) { return (a.nx * b.nx + a.ny * b.ny) + a.nz * b.nz; }

    Floats random_depth(Random& random) const {
        const float near = 1.0f / problem_.nearest, far = 1.0f / problem_.farthest;
        return Floats(1.0f) / (Floats(far) + random.unit() * Floats(near - far));
    }

    // A random direction within about 60 degrees of the ray towards the camera.
    Planes random_normal(Random& random, Planes planes) const {
        const Floats by = Floats(-1.0f) / ray_length();
        planes.nx = group_.patches.ray_x * by, planes.ny = group_.patches.ray_y * by, planes.nz = by;
        return perturb_normal(random, 1.5f, planes);
    }

    static Planes perturb_normal(Random& random, float by, Planes planes) {
        const Floats nx = planes.nx + Floats(by) * random.symmetric(), ny = planes.ny + Floats(by) * random.symmetric(),
                     nz = planes.nz + Floats(by) * random.symmetric();
        const Floats length = root((nx * nx + ny * ny) + nz * nz);
        return select_planes(Floats(1e-3f) < length, {planes.depth, nx / length, ny / length, nz / length}, planes);
    }

    static constexpr float kGoodCost = 0.6f, kBadCost = 1.2f, kRestartCost = 0.4f;
    static constexpr float kSimilarDisplacementPx = 0.1f, kSimilarCosine = 0.996f;
    static constexpr float kVotes = 4;  // of the eight neighbours

    const Problem& problem_;
    State& state_;
    Group<kEvery> group_;
    int sources_;
    Planes plane_;
    Floats cost_, sum_, total_weight_;  // weighted mean and sum of the costs per view, sum of the weights
    Floats view_costs_[kMaxSources], weights_[kMaxSources];
};

// Run one sweep, one colour after the other. Perturbations shrink with the sweep index, which starts at 0.
template <int kEvery>
inline bool sweep_with(const Problem& problem, State& state, int sweep_index, Interrupt& interrupt) {
    for (int colour = 0; colour < 2; ++colour) {
        pack_costs_by_colour(problem, state, 1 - colour);
#pragma omp parallel for schedule(dynamic, 4)
        for (int y = 0; y < problem.height; ++y) {
            if (interrupt.requested()) continue;
            for (int first = (y + colour) & 1; first < problem.width; first += 2 * kLanes)
                Search<kEvery>(problem, state, y, first).improve(sweep_index);
        }
    }
    return !interrupt.stopped();
}

// Score the initial planes of all pixels.
template <int kEvery>
inline bool initialize_with(const Problem& problem, State& state, Interrupt& interrupt) {
#pragma omp parallel for schedule(dynamic, 4)
    for (int y = 0; y < problem.height; ++y) {
        if (interrupt.requested()) continue;
        for (int colour = 0; colour < 2; ++colour)
            for (int first = colour; first < problem.width; first += 2 * kLanes)
                Search<kEvery>(problem, state, y, first).initialize();
    }
    return !interrupt.stopped();
}

inline bool sweep(const Problem& problem, State& state, int sweep_index, Interrupt& interrupt) {
    return (problem.half_patches ? sweep_with<2> : sweep_with<1>)(problem, state, sweep_index, interrupt);
}

inline bool initialize(const Problem& problem, State& state, Interrupt& interrupt) {
    return (problem.half_patches ? initialize_with<2> : initialize_with<1>)(problem, state, interrupt);
}

}  // namespace pcbench::mvs::PCB_ISA
