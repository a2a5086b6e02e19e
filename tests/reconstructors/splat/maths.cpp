// A rasterizer of loops over maths.h alone, pixel by pixel and Gaussian by Gaussian, called through ctypes. REAL is
// float, or double if maths.h has been rewritten for it: in double the formulas can be compared with many more digits.

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#define PCB_FN inline
using Real = REAL;

inline Real fused(Real a, Real b, Real c) { return std::fma(a, b, c); }
inline Real root(Real x) { return std::sqrt(x); }
inline Real lesser(Real a, Real b) { return a < b ? a : b; }
inline Real greater(Real a, Real b) { return a < b ? b : a; }
inline Real select(bool mask, Real yes, Real no) { return mask ? yes : no; }
inline Real add_exponent(Real x, Real n) { return std::ldexp(x, static_cast<int>(n)); }
inline Real exponent(Real x, Real& mantissa) {
    int n;
    mantissa = Real(2) * std::frexp(x, &n);
    return Real(n - 1);
}

#include MATHS

#ifdef EXACT  // the two polynomials have float precision
template <>
inline double exp2_of<double>(double x) {
    return std::exp2(x);
}
template <>
inline double log2_of<double>(double x) {
    return std::log2(x);
}
#endif

namespace {

Pinhole pinhole(const Real* view, int width, int height) {  // rotation, position, fx fy cx cy, limits, near, cutoffs
    Pinhole at;
    std::copy(view, view + 9, at.rotation);
    std::copy(view + 9, view + 12, at.position);
    at.fx = view[12], at.fy = view[13], at.cx = view[14], at.cy = view[15];
    at.left = view[16], at.right = view[17], at.top = view[18], at.bottom = view[19], at.nearest = view[20];
    at.min_alpha = view[21], at.min_level = view[22], at.min_transmittance = view[23];
    at.width = width, at.height = height;
    return at;
}

struct Projected {
    Footprint<Real> footprint;
    Splat<Real> splat;
    bool drawn;
};

Vec<Real> color_of(const Real* sh, int count, Vec<Real> offset) {
    Real basis[kMaxHarmonics];
    harmonics(unit(offset), count, basis);
    Vec<Real> sum{Real(0.5), Real(0.5), Real(0.5)};
    for (int k = 0; k < count; ++k) sum = fused(basis[k], Vec<Real>{sh[3 * k], sh[3 * k + 1], sh[3 * k + 2]}, sum);
    return sum;
}

}  // namespace

extern "C" {

void exp2_and_log2(int n, const Real* x, Real* powers, Real* logarithms) {
    for (int i = 0; i < n; ++i) powers[i] = exp2_of(x[i]), logarithms[i] = log2_of(std::fabs(x[i]));
}

void min_squared_norms(int n, const Real* in, Real* out) {  // uu uv vv x0 x1 y0 y1
    for (int i = 0; i < n; ++i, in += 7) out[i] = min_squared_norm(in[0], in[1], in[2], in[3], in[4], in[5], in[6]);
}

// images: color (3), transmittance, depth, normal (3) of each pixel; sums: gradients with respect to these 8;
// gradients, per Gaussian: mean (3), quaternion (4), scale (3), opacity, screen (2); sh_gradients: harmonics; boxes: x0
// x1 y0 y1 of each ellipse and its reach. Without `sums` it only renders.
void rasterize(int n, int count, const Real* means, const Real* quats, const Real* scales, const Real* opacities,
               const Real* sh, const Real* view, int width, int height, const Real* background, Real* images,
               Real* median, Real* boxes, const Real* sums, Real* gradients, Real* sh_gradients) {
    const Pinhole at = pinhole(view, width, height);
    std::vector<Projected> all(n);
    std::vector<Vec<Real>> free_color(n);
    std::vector<int> order;
    for (int i = 0; i < n; ++i) {
        Projected& projected = all[i];
        const Vec<Real> mean{means[3 * i], means[3 * i + 1], means[3 * i + 2]};
        const Vec<Real> scale{scales[3 * i], scales[3 * i + 1], scales[3 * i + 2]};
        const Quaternion<Real> quaternion{quats[4 * i], quats[4 * i + 1], quats[4 * i + 2], quats[4 * i + 3]};
        projected.splat = project(at, mean, quaternion, scale, opacities[i], projected.footprint, projected.drawn);
        const Footprint<Real>& f = projected.footprint;
        free_color[i] = color_of(sh + 3 * count * i, count, f.offset);
        const Vec<Real> c = free_color[i];
        projected.splat.color = {greater(c.x, Real(0)), greater(c.y, Real(0)), greater(c.z, Real(0))};
        const Real box[5] = {projected.splat.x - f.extent_x, projected.splat.x + f.extent_x,
                             projected.splat.y - f.extent_y, projected.splat.y + f.extent_y,
                             projected.drawn ? f.reach : Real(-1)};
        std::copy(box, box + 5, boxes + 5 * i);
        if (projected.drawn) order.push_back(i);
    }
    std::stable_sort(order.begin(), order.end(), [&](int a, int b) { return all[a].splat.depth < all[b].splat.depth; });

    std::vector<Moments<Real>> moments(n);
    std::memset(static_cast<void*>(moments.data()), 0, n * sizeof(Moments<Real>));
    const auto visit = [&](int pixel, const auto& see) {
        Real left = 1;
        for (const int i : order) {
            const Splat<Real>& s = all[i].splat;
            const Real dx = Real(pixel % width) + Real(0.5) - s.x, dy = Real(pixel / width) + Real(0.5) - s.y;
            const Real u = fused(s.uu, dx, s.uv * dy), v = s.vv * dy, alpha = alpha_at(s.level, u, v);
            if (alpha < at.min_alpha) continue;
            const Real clamped = lesser(alpha, Real(kMaxAlpha)), next = left * (1 - clamped);
            if (next < at.min_transmittance) break;
            see(i, u, v, clamped, alpha <= kMaxAlpha, left, next);
            left = next;
        }
        return left;
    };
    for (int pixel = 0; pixel < width * height; ++pixel) {
        Vec<Real> color{0, 0, 0}, normal{0, 0, 0};
        Real depth = 0, middle = 0;
        const auto blend = [&](int i, Real u, Real v, Real alpha, bool, Real left, Real next) {
            const Splat<Real>& s = all[i].splat;
            const Real plane = fused(s.depth_u, u, fused(s.depth_v, v, s.depth));
            color = fused(alpha * left, s.color, color);
            normal = fused(alpha * left, s.normal, normal);
            depth = fused(alpha * left, plane, depth);
            if (left >= Real(0.5) && next < Real(0.5)) middle = plane;
        };
        const Real left = visit(pixel, blend);
        color = fused(left, Vec<Real>{background[0], background[1], background[2]}, color);
        const Real image[8] = {color.x, color.y, color.z, left, depth, normal.x, normal.y, normal.z};
        std::copy(image, image + 8, images + 8 * pixel);
        median[pixel] = middle;
        if (!sums) continue;
        const Real* d = sums + 8 * pixel;
        Real behind = 0;
        for (int k = 0; k < 8; ++k) behind += d[k] * image[k];
        const PixelGradient<Real> g{{d[0], d[1], d[2]}, d[4], {d[5], d[6], d[7]}};
        visit(pixel, [&](int i, Real u, Real v, Real alpha, bool unclamped, Real left, Real) {
            add_pixel<kNormals>(all[i].splat, u, v, alpha, unclamped, left, g, behind, moments[i]);
        });
    }
    if (!sums) return;
    for (const int i : order) {
        const Moments<Real>& m = moments[i];
        const Vec<Real> scale{scales[3 * i], scales[3 * i + 1], scales[3 * i + 2]};
        Gradient<Real> g = project_gradient(at, scale, opacities[i], all[i].footprint, all[i].splat, m);
        const Vec<Real> c = free_color[i], offset = all[i].footprint.offset;
        const Vec<Real> grad_color{c.x > 0 ? m.color.x : 0, c.y > 0 ? m.color.y : 0, c.z > 0 ? m.color.z : 0};
        Real basis[kMaxHarmonics], grad_basis[kMaxHarmonics];
        harmonics(unit(offset), count, basis);
        for (int k = 0; k < count; ++k) {
            const Real* one = sh + 3 * (count * i + k);
            grad_basis[k] = dot(Vec<Real>{one[0], one[1], one[2]}, grad_color);
            const Real grad[3] = {basis[k] * grad_color.x, basis[k] * grad_color.y, basis[k] * grad_color.z};
            std::copy(grad, grad + 3, sh_gradients + 3 * (count * i + k));
        }
        g.mean = g.mean + unit_gradient(offset, harmonics_gradient(unit(offset), count, grad_basis));
        const Real out[13] = {g.mean.x,       g.mean.y,       g.mean.z,  g.quaternion.w, g.quaternion.x,
                              g.quaternion.y, g.quaternion.z, g.scale.x, g.scale.y,      g.scale.z,
                              g.opacity,      g.screen_x,     g.screen_y};
        std::copy(out, out + 13, gradients + 13 * i);
    }
}
}
