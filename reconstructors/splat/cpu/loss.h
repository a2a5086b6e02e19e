// The training loss of two images and its gradient: absolute difference and structural similarity (Wang et al. 2004)
// with a Gaussian window of 11 pixels, zero beyond the border. One row at a time; the channels are interleaved, so the
// next pixel is three floats away.
#pragma once
#include "rows.h"

namespace PCB_SPACE {

constexpr int kRadius = 5;  // pixels from the window's centre
constexpr int kChannels = 3;
constexpr float kWindow[kRadius + 1] = {0.266011721f,  0.213005528f,   0.109360688f,  // exp(-k^2 / 2 / 1.5^2), sum 1
                                        0.0360007733f, 0.00759875821f, 0.00102838012f};
constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
constexpr int kMargin =
    kRadius * kChannels + 1;  // floats before and after a row of sums; one more keeps it a multiple of 16

// Floats of a row of sums with its margins, rounded up to complete vectors.
inline int padded(int length) { return (length + kLanes - 1) / kLanes * kLanes + 2 * kMargin; }

// A vector of a row at `at`, zero after the row's end.
inline Floats row_at(const float* row, int at, int length) {
    return at + kLanes <= length ? load(row + at) : load_first(row + at, length - at);
}
inline void write_row(float* row, int at, int length, Floats values) {
    if (at + kLanes <= length)
        store(row + at, values);
    else
        store_first(row + at, length - at, values);
}

// The first `count` lanes; the others are zero.
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

// The horizontal window over a row of vertical sums at `at`.
inline Floats across(const float* sums, int at) {
    const float* center = sums + kMargin + at;
    Floats out = Floats(kWindow[0]) * load(center);
    for (int k = 1; k <= kRadius; ++k)
        out = fused(Floats(kWindow[k]), load(center - kChannels * k) + load(center + kChannels * k), out);
    return out;
}

inline void similarity(const float* x, const float* y, int height, int length, int row, float* scratch,
                       float* grad_mean, float* grad_square, float* grad_product, double* sums) {
    const int size = padded(length);
    float *mean_x = scratch, *mean_y = scratch + size, *squares = scratch + 2 * size, *products = scratch + 3 * size;
    const Floats zero = Floats(0.0f), two = Floats(2.0f), c1 = Floats(kC1), c2 = Floats(kC2);
    clear_margins(scratch, length, 4);
    const int top = row - kRadius > 0 ? row - kRadius : 0, bottom = row + kRadius < height ? row + kRadius : height - 1;
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
        const Floats inverse = Floats(1.0f) / (b1 * b2), value = a1 * a2 * inverse;
        const Floats slope = value / b2, grad_p = two * a1 * inverse;
        write_row(grad_product, at, length, grad_p);
        write_row(grad_square, at, length, -slope);
        write_row(grad_mean, at, length,
                  two * (my * a2 * inverse - mx * value / b1) - (my * grad_p - two * mx * slope));
        const Floats difference = row_at(x, at, length) - row_at(y, at, length);
        differences = differences + greater(difference, -difference);
        similarities = similarities + first_of(value, length - at);
    }
    sums[0] = sum(differences), sums[1] = sum(similarities);
}

inline void loss_gradient(const float* x, const float* y, int height, int length, int row, float weight, float* scratch,
                          const float* grad_mean, const float* grad_square, const float* grad_product, float* out) {
    const int size = padded(length);
    const float* maps[3] = {grad_mean, grad_square, grad_product};
    clear_margins(scratch, length, 3);
    const int top = row - kRadius > 0 ? row - kRadius : 0, bottom = row + kRadius < height ? row + kRadius : height - 1;
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
    const Floats grad_similarity = Floats(-weight * per), grad_difference = Floats((1.0f - weight) * per);
    for (int at = 0; at < length; at += kLanes) {
        const Floats a = row_at(x, at, length), b = row_at(y, at, length);
        const Floats s = fused(Floats(2.0f) * a, across(scratch + size, at),
                               fused(b, across(scratch + 2 * size, at), across(scratch, at)));
        const Floats sign = select(b < a, grad_difference, select(a < b, -grad_difference, zero));
        write_row(out, at, length, fused(grad_similarity, s, sign));
    }
}

}  // namespace PCB_SPACE
