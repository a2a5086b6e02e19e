// PatchMatch: planes pass from pixel to pixel of the other colour of a chessboard and are varied at random, and what
// explains the sources better is kept (Galliani et al. 2015; the eight regions and the choice of views: Xu and Tao
// 2019). Included once for each instruction set, see kernels_isa.h.
#pragma once
#include "score.h"

namespace pcbench::mvs::PCB_ISA {

constexpr int kRegions = 8, kRounds = 5;

struct Plane {
    float depth, nx, ny, nz;
};

// Numbers that depend on what they are for alone, not on the order of the work.
class Random {
public:
    Random(uint32_t seed, int64_t pixel, int sweep)
        : state_(seed ^ mixed(static_cast<uint32_t>(pixel) ^ mixed(sweep))) {}
    float unit() {  // 0 to 1
        state_ = state_ * 747796405u + 2891336453u;
        return static_cast<float>(mixed(state_) >> 8) * (1.0f / 16777216.0f);
    }
    float symmetric() { return 2.0f * unit() - 1.0f; }

private:
    static uint32_t mixed(uint32_t v) {
        v ^= v >> 16, v *= 0x7feb352du, v ^= v >> 15, v *= 0x846ca68bu;
        return v ^ v >> 16;
    }
    uint32_t state_;
};

// The planes of one group that are compared, many for each pixel.
struct Candidates {
    static constexpr int kMost = kRegions * kLanes;
    int count = 0;
    int lane[kMost];
    Plane plane[kMost];
    float cost[kMost][kMaxSources];

    int add(int at, const Plane& p) {
        lane[count] = at;
        plane[count] = p;
        return count++;
    }

    void score_all(const Problem& problem, const Group& group) {
        for (int first = 0; first < count; first += kLanes) {
            Planes planes;
            float costs[kMaxSources][kLanes];
            planes.count = count - first < kLanes ? count - first : kLanes;
            for (int l = 0; l < kLanes; ++l) {
                const int from = first + (l < planes.count ? l : planes.count - 1);
                planes.lane[l] = lane[from];
                planes.depth[l] = plane[from].depth;
                planes.nx[l] = plane[from].nx, planes.ny[l] = plane[from].ny, planes.nz[l] = plane[from].nz;
            }
            score(problem, group, planes, costs);
            for (int s = 0; s < problem.source_count; ++s)
                for (int l = 0; l < planes.count; ++l) cost[first + l][s] = costs[s][l];
        }
    }
};

class Sweep {
public:
    Sweep(const Problem& problem, State& state, int number)
        : problem_(problem), state_(state), number_(number), sources_(problem.source_count) {
        // From pixels to fractions of one, and from wide turns to small ones.
        reach_ = 2.0f;
        tilt_ = 0.5f;
        for (int i = 0; i < number; ++i) reach_ *= 0.5f, tilt_ *= 0.6f;
    }

    // The costs of the planes there are; pixels without one get one at random.
    void begin(const Group& group) {
        Candidates all;
        for (int l = 0; l < group.count; ++l) {
            const int64_t at = group.pixel[l];
            if (!valid(at)) {
                state_.plane[4 * at] = 0;
                state_.cost[at] = kWorst;
                continue;
            }
            Plane plane = plane_at(at);
            if (!sensible(group, l, plane)) {
                Random random(problem_.seed, at, -1);
                plane = {random_depth(random), 0, 0, -1};
                random_normal(random, group, l, plane);
            }
            put(at, plane);
            all.add(l, plane);
        }
        all.score_all(problem_, group);
        for (int i = 0; i < all.count; ++i) {
            const int64_t at = group.pixel[all.lane[i]];
            float total = 0, weights = 0;
            for (int s = 0; s < sources_; ++s) {
                const float weight = trust(all.cost[i][s]);
                state_.view_costs[at * sources_ + s] = all.cost[i][s];
                total += weight * all.cost[i][s], weights += weight;
            }
            state_.cost[at] = weights > 0 ? total / weights : kWorst;
        }
    }

    void improve(const Group& group) {
        spread(group);
        vary(group);
    }

private:
    static constexpr int kMine = -1, kNone = -2;

    // Takes over the planes of neighbours that explain a pixel better, after choosing the views that count there.
    void spread(const Group& group) {
        Candidates all;
        int which[kLanes][kRegions];
        for (int l = 0; l < group.count; ++l) {
            const int64_t at = group.pixel[l];
            if (!valid(at)) continue;
            const Plane mine = plane_at(at);
            int64_t regions[kRegions];
            best_of_regions(group.x[l], group.y, regions);
            for (int r = 0; r < kRegions; ++r) {
                which[l][r] = kNone;
                if (regions[r] < 0) continue;
                Plane plane = plane_at(regions[r]);
                plane.depth = depth_at(group, l, plane, regions[r]);
                if (!sensible(group, l, plane)) continue;
                which[l][r] = same(plane, mine) ? kMine : kNone;
                for (int earlier = 0; earlier < r && which[l][r] == kNone; ++earlier)
                    if (which[l][earlier] >= 0 && same(plane, all.plane[which[l][earlier]]))
                        which[l][r] = which[l][earlier];
                if (which[l][r] == kNone) which[l][r] = all.add(l, plane);
            }
        }
        all.score_all(problem_, group);
        for (int l = 0; l < group.count; ++l) {
            const int64_t at = group.pixel[l];
            if (!valid(at)) continue;
            float* mine = state_.view_costs + at * sources_;
            choose_views(which[l], all, mine, weights_[l]);
            state_.cost[at] = mean(mine, weights_[l]);
            for (int r = 0; r < kRegions; ++r)
                if (which[l][r] >= 0) take_if_better(at, all, which[l][r], weights_[l]);
        }
    }

    void vary(const Group& group) {
        for (int round = 0; round < kRounds; ++round) {
            Candidates all;
            for (int l = 0; l < group.count; ++l) {
                const int64_t at = group.pixel[l];
                if (!valid(at)) continue;
                Random random(problem_.seed, at, number_ * kRounds + round);
                const Plane mine = plane_at(at);
                Plane plane = mine;
                if (round < 3) {
                    if (round != 1) {
                        const float step = random.symmetric() * reach_ / problem_.pixels_per_depth;
                        plane.depth = 1.0f / (1.0f / mine.depth + step);
                    }
                    if (round != 0) turn(random, tilt_, plane);
                } else if (state_.cost[at] > kLost) {
                    if (round == 3) plane.depth = random_depth(random);
                    random_normal(random, group, l, plane);
                } else {
                    continue;
                }
                if (sensible(group, l, plane)) all.add(l, plane);
            }
            all.score_all(problem_, group);
            for (int i = 0; i < all.count; ++i) take_if_better(group.pixel[all.lane[i]], all, i, weights_[all.lane[i]]);
        }
    }

    // The best pixel of each region, as far as there is one: four wedges nearby and four lines further away.
    void best_of_regions(int x, int y, int64_t* best) const {
        static constexpr int8_t kWedge[7][2] = {{0, 1}, {-1, 2}, {1, 2}, {-2, 3}, {2, 3}, {-3, 4}, {3, 4}};
        for (int side = 0; side < 4; ++side) {
            const auto offer = [&](int64_t& kept, int across, int along) {
                const int dx = side == 0 ? across : side == 1 ? across : side == 2 ? along : -along;
                const int dy = side == 0 ? along : side == 1 ? -along : across;
                const int px = x + dx, py = y + dy;
                if (px < 0 || py < 0 || px >= problem_.width || py >= problem_.height) return;
                const int64_t at = static_cast<int64_t>(py) * problem_.width + px;
                if (!valid(at)) return;
                if (kept < 0 || state_.cost[at] < state_.cost[kept]) kept = at;
            };
            best[side] = best[4 + side] = -1;
            for (const auto& step : kWedge) offer(best[side], step[0], step[1]);
            for (int along = 5; along <= 25; along += 2) offer(best[4 + side], 0, along);
        }
    }

    // A view counts as far as the neighbours' planes find it to agree; one that most of them find to disagree is taken
    // to see something else. Where no view is left each counts as far as the best plane says.
    void choose_views(const int* which, const Candidates& all, const float* mine, float* weights) const {
        float total = 0;
        for (int s = 0; s < sources_; ++s) {
            int good = 0, bad = 0, count = 0;
            float sum = 0;
            for (int r = 0; r < kRegions; ++r) {
                if (which[r] == kNone) continue;
                const float cost = which[r] == kMine ? mine[s] : all.cost[which[r]][s];
                ++count;
                if (cost < kGood) ++good, sum += trust(cost);
                bad += cost > kBad;
            }
            weights[s] = good > 2 && bad < 3 ? sum / static_cast<float>(good) : 0.0f;
            total += weights[s];
        }
        if (total > 0) return;
        for (int s = 0; s < sources_; ++s) {
            float least = mine[s];
            for (int r = 0; r < kRegions; ++r)
                if (which[r] >= 0 && all.cost[which[r]][s] < least) least = all.cost[which[r]][s];
            weights[s] = trust(least);
        }
    }

    float mean(const float* costs, const float* weights) const {
        float sum = 0, total = 0;
        for (int s = 0; s < sources_; ++s) sum += weights[s] * costs[s], total += weights[s];
        return total > 0 ? sum / total : kWorst;
    }

    void take_if_better(int64_t at, const Candidates& all, int which, const float* weights) {
        const float cost = mean(all.cost[which], weights);
        if (!(cost < state_.cost[at])) return;
        put(at, all.plane[which]);
        state_.cost[at] = cost;
        for (int s = 0; s < sources_; ++s) state_.view_costs[at * sources_ + s] = all.cost[which][s];
    }

    // Falls from 1 at no cost to 0.
    static float trust(float cost) {
        const float d = 1.0f + cost * cost * (1.0f / (2 * 0.3f * 0.3f));
        return cost < kWorst ? 1.0f / (d * d) : 0.0f;
    }

    bool valid(int64_t at) const { return problem_.valid == nullptr || problem_.valid[at] != 0; }

    Plane plane_at(int64_t at) const {
        const float* p = state_.plane + 4 * at;
        return {p[0], p[1], p[2], p[3]};
    }

    void put(int64_t at, const Plane& plane) {
        float* p = state_.plane + 4 * at;
        p[0] = plane.depth, p[1] = plane.nx, p[2] = plane.ny, p[3] = plane.nz;
    }

    // Where the plane of another pixel meets this one's ray.
    float depth_at(const Group& group, int l, const Plane& plane, int64_t other) const {
        const float ox = (static_cast<float>(other % problem_.width) - problem_.cx) / problem_.fx;
        const float oy = (static_cast<float>(other / problem_.width) - problem_.cy) / problem_.fy;
        const float there = (plane.nx * ox + plane.ny * oy) + plane.nz;
        const float here = (plane.nx * group.ray_x[l] + plane.ny * group.ray_y[l]) + plane.nz;
        return plane.depth * (there / here);
    }

    // In the range, and not seen from behind or along itself.
    bool sensible(const Group& group, int l, const Plane& plane) const {
        const float facing = (plane.nx * group.ray_x[l] + plane.ny * group.ray_y[l]) + plane.nz;
        const float length =
            __builtin_sqrtf((group.ray_x[l] * group.ray_x[l] + group.ray_y[l] * group.ray_y[l]) + 1.0f);
        return plane.depth >= problem_.nearest && plane.depth <= problem_.farthest && facing < -0.1f * length;
    }

    // Too little apart to tell by the images.
    bool same(const Plane& a, const Plane& b) const {
        const float moved = (1.0f / a.depth - 1.0f / b.depth) * problem_.pixels_per_depth;
        const float cosine = (a.nx * b.nx + a.ny * b.ny) + a.nz * b.nz;
        return __builtin_fabsf(moved) < kSameMove && cosine > kSameCosine;
    }

    float random_depth(Random& random) const {
        const float near = 1.0f / problem_.nearest, far = 1.0f / problem_.farthest;
        return 1.0f / (far + random.unit() * (near - far));
    }

    // Any direction within 60 degrees of the ray back to the camera, about evenly.
    void random_normal(Random& random, const Group& group, int l, Plane& plane) const {
        const float length =
            __builtin_sqrtf((group.ray_x[l] * group.ray_x[l] + group.ray_y[l] * group.ray_y[l]) + 1.0f);
        plane.nx = -group.ray_x[l] / length, plane.ny = -group.ray_y[l] / length, plane.nz = -1.0f / length;
        turn(random, 1.5f, plane);
    }

    static void turn(Random& random, float by, Plane& plane) {
        const float nx = plane.nx + by * random.symmetric(), ny = plane.ny + by * random.symmetric(),
                    nz = plane.nz + by * random.symmetric();
        const float length = __builtin_sqrtf((nx * nx + ny * ny) + nz * nz);
        if (length < 1e-3f) return;
        plane.nx = nx / length, plane.ny = ny / length, plane.nz = nz / length;
    }

    static constexpr float kGood = 0.6f, kBad = 1.2f, kLost = 0.4f;
    static constexpr float kSameMove = 0.05f, kSameCosine = 0.999f;

    const Problem& problem_;
    State& state_;
    int number_;
    int sources_;
    float reach_, tilt_;
    float weights_[kLanes][kMaxSources];
};

// One colour after the other. Number: of the sweep, from 0, after which the steps of the variation are halved.
inline bool sweep(const Problem& problem, State& state, int number, Interrupt& interrupt) {
    for (int colour = 0; colour < 2; ++colour) {
#pragma omp parallel for schedule(dynamic, 4)
        for (int y = 0; y < problem.height; ++y) {
            if (interrupt.requested()) continue;
            Sweep work(problem, state, number);
            for (int first = (y + colour) & 1; first < problem.width; first += 2 * kLanes)
                work.improve(Group(problem, y, first));
        }
    }
    return !interrupt.stopped();
}

inline bool begin(const Problem& problem, State& state, Interrupt& interrupt) {
#pragma omp parallel for schedule(dynamic, 4)
    for (int y = 0; y < problem.height; ++y) {
        if (interrupt.requested()) continue;
        Sweep work(problem, state, 0);
        for (int colour = 0; colour < 2; ++colour)
            for (int first = colour; first < problem.width; first += 2 * kLanes) work.begin(Group(problem, y, first));
    }
    return !interrupt.stopped();
}

}  // namespace pcbench::mvs::PCB_ISA
