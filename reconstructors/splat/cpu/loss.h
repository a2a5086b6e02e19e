// The training loss of two pictures and its derivative: absolute difference and structural similarity (Wang et al.
// 2004) under a Gaussian window of 11 pixels, zero beyond the border. A row at a time; the channels lie interleaved, so
// the neighbour across is three floats away.
#pragma once
#include "rows.h"

namespace PCB_SPACE {

constexpr int kReach = 5;  // pixels from the window's centre
constexpr int kChannels = 3;
constexpr float kWindow[kReach + 1] = {0.266011721f,  0.213005528f,   0.109360688f,  // exp(-k^2 / 2 / 1.5^2), sum 1
                                       0.0360007733f, 0.00759875821f, 0.00102838012f};
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
constexpr int kMargin = kReach * kChannels + 1;  // floats before and behind a row of sums; one more, so that 16 remain

// Room for `rows` rows of sums with margins and space for a whole last vector.
inline int padded(int length) { return (length + kLanes - 1) / kLanes * kLanes + 2 * kMargin; }

// A vector of a row at `at`, zero behind its end.
inline Floats row_at(const float* row, int at, int length) {
    return at + kLanes <= length ? load(row + at) : load_first(row + at, length - at);
}
inline void write_row(float* row, int at, int length, Floats values) {
    if (at + kLanes <= length)
        store(row + at, values);
    else
        store_first(row + at, length - at, values);
}

// Zero but for the first `count` lanes.
inline Floats first_of(Floats values, int count) {
    if (count >= kLanes) return values;
    float lanes[kLanes];
    store(lanes, values);
    return load_first(lanes, count);
}

inline void clear_margins(float* sums, int length, int maps) {
    const int size = padded(length);
    for (int k = 0; k < maps; ++k)
        for (int i = 0; i < kMargin; ++i) sums[k * size + i] = sums[k * size + size - 1 - i] = 0.0f;
}

// The window across, of a row of sums down at `at`.
inline Floats across(const float* sums, int at) {
    const float* center = sums + kMargin + at;
    Floats out = Floats(kWindow[0]) * load(center);
    for (int k = 1; k <= kReach; ++k)
        out = fused(Floats(kWindow[k]), load(center - kChannels * k) + load(center + kChannels * k), out);
    return out;
}

inline void similarity(const float* x, const float* y, int height, int length, int row, float* scratch, float* by_mean,
                       float* by_square, float* by_product, double* sums) {
    const int size = padded(length);
    float *mean_x = scratch, *mean_y = scratch + size, *squares = scratch + 2 * size, *products = scratch + 3 * size;
    const Floats zero = Floats(0.0f), two = Floats(2.0f), c1 = Floats(kC1), c2 = Floats(kC2);
    clear_margins(scratch, length, 4);
    const int top = row - kReach > 0 ? row - kReach : 0, bottom = row + kReach < height ? row + kReach : height - 1;
    for (int at = 0; at < length; at += kLanes) {
        Floats mx = zero, my = zero, s = zero, p = zero;
        for (int r = top; r <= bottom; ++r) {
            const Floats weight = Floats(kWindow[r < row ? row - r : r - row]);
            const Floats a = row_at(x + static_cast<size_t>(length) * r, at, length);
            const Floats b = row_at(y + static_cast<size_t>(length) * r, at, length);
            const Floats wa = weight * a, wb = weight * b;
            mx = mx + wa, my = my + wb;
            s = fused(wa, a, fused(wb, b, s));
            p = fused(wa, b, p);
        }
        store(mean_x + kMargin + at, mx), store(mean_y + kMargin + at, my);
        store(squares + kMargin + at, s), store(products + kMargin + at, p);
    }
    Floats differences = zero, similarities = zero;
    x += static_cast<size_t>(length) * row, y += static_cast<size_t>(length) * row;
    for (int at = 0; at < length; at += kLanes) {
        const Floats mx = across(mean_x, at), my = across(mean_y, at);
        const Floats mxy = mx * my, mm = fused(mx, mx, my * my);
        const Floats a1 = fused(two, mxy, c1), a2 = fused(two, across(products, at) - mxy, c2);
        const Floats b1 = mm + c1, b2 = (across(squares, at) - mm) + c2;
        const Floats below = Floats(1.0f) / (b1 * b2), value = a1 * a2 * below;
        const Floats slope = value / b2, by_p = two * a1 * below;
        write_row(by_product, at, length, by_p);
        write_row(by_square, at, length, -slope);
        write_row(by_mean, at, length, two * (my * a2 * below - mx * value / b1) - (my * by_p - two * mx * slope));
        const Floats difference = row_at(x, at, length) - row_at(y, at, length);
        differences = differences + greater(difference, -difference);
        similarities = similarities + first_of(value, length - at);
    }
    sums[0] = sum(differences), sums[1] = sum(similarities);
}

inline void loss_gradient(const float* x, const float* y, int height, int length, int row, float weight, float* scratch,
                          const float* by_mean, const float* by_square, const float* by_product, float* out) {
    const int size = padded(length);
    const float* maps[3] = {by_mean, by_square, by_product};
    clear_margins(scratch, length, 3);
    const int top = row - kReach > 0 ? row - kReach : 0, bottom = row + kReach < height ? row + kReach : height - 1;
    const Floats zero = Floats(0.0f);
    for (int k = 0; k < 3; ++k)
        for (int at = 0; at < length; at += kLanes) {
            Floats total = zero;
            for (int r = top; r <= bottom; ++r)
                total = fused(Floats(kWindow[r < row ? row - r : r - row]),
                              row_at(maps[k] + static_cast<size_t>(length) * r, at, length), total);
            store(scratch + k * size + kMargin + at, total);
        }
    x += static_cast<size_t>(length) * row, y += static_cast<size_t>(length) * row;
    out += static_cast<size_t>(length) * row;
    const float per = 1.0f / (static_cast<float>(height) * static_cast<float>(length));
    const Floats by_similarity = Floats(-weight * per), by_difference = Floats((1.0f - weight) * per);
    for (int at = 0; at < length; at += kLanes) {
        const Floats a = row_at(x, at, length), b = row_at(y, at, length);
        const Floats s = fused(Floats(2.0f) * a, across(scratch + size, at),
                               fused(b, across(scratch + 2 * size, at), across(scratch, at)));
        const Floats sign = select(b < a, by_difference, select(a < b, -by_difference, zero));
        write_row(out, at, length, fused(by_similarity, s, sign));
    }
}

}  // namespace PCB_SPACE
