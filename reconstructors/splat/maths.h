// The mathematics of Gaussian splatting, one copy for all devices. The CPU includes it once for each instruction set,
// with F a SIMD vector or a float; NVRTC reads it before the CUDA kernels, with F a float.
//
// It includes nothing. The including file provides pinhole.h and PCB_FN (the prefix of a function) and, for each F,
// + - * / <, the conversion from a float, fused(a, b, c) = a * b + c rounded once, root, lesser, greater,
// select(mask, yes, no), add_exponent(x, n), which multiplies x by 2^n, and exponent(x, mantissa), which splits x > 0
// into 2^n * mantissa in [1, 2). None of them depends on the device, so all devices add and round in the same way.
//
// Conventions: the camera looks along +z, x to the right, y down; the centre of pixel (i, j) is at (i + 0.5, j + 0.5);
// quaternions are wxyz. Papers: Zwicker et al. 2001, EWA volume splatting; Kerbl et al. 2023, 3D Gaussian splatting;
// Zhang et al. 2024, RaDe-GS (depth as a plane).
//
// In pixel units, a Gaussian is alpha = 2^(level - u^2 - v^2), where (u, v) are its whitened coordinates: a triangular
// matrix times the offset of the pixel from the projected mean. A sum of two squares cannot cancel, unlike the
// quadratic form of an inverted covariance, whose cancellation is visible for needles far from their mean.

constexpr float kMaxAlpha = 0.99f;
constexpr float kDilation = 0.3f;  // square pixels added to the projected covariance
constexpr float kLn2 = 0.693147181f;
constexpr float kWhitening = 0.849321800f;       // sqrt(log2(e) / 2): exp(-x^2 / 2) = 2^-(kWhitening x)^2
constexpr float kMinSquaredQuaternion = 1e-24f;  // squared norm below which a rotation is undefined
constexpr float kMaxDeterminant = 1e36f;         // of a covariance in pixels: squares of larger ones overflow a float
constexpr int kMaxHarmonics = 16;                // spherical harmonics up to degree 3

// ---- functions of numbers

// 2^x for |x| < 126, with a relative error of 2e-7: a minimax polynomial of degree 5 on [-1/2, 1/2].
template <class F>
PCB_FN F exp2_of(F x) {
    const F magic = F(12582912.0f);  // 1.5 * 2^23: adding it rounds to the nearest integer
    const F whole = (x + magic) - magic;
    const F rest = x - whole;
    F y = fused(rest, F(0.0013276472f), F(0.0096755415f));
    y = fused(y, rest, F(0.0555071328f));
    y = fused(y, rest, F(0.240221197f));
    y = fused(y, rest, F(0.693146967f));
    y = fused(y, rest, F(1.0f));
    return add_exponent(y, whole);
}

// log2(x) of a normal x > 0, with an error of 2e-7: the series of the inverse hyperbolic tangent about 1.
template <class F>
PCB_FN F log2_of(F x) {
    F mantissa;
    F whole = exponent(x, mantissa);
    const auto high = F(1.41421356f) < mantissa;
    mantissa = select(high, mantissa * F(0.5f), mantissa);
    whole = select(high, whole + F(1.0f), whole);
    const F s = (mantissa - F(1.0f)) / (mantissa + F(1.0f));
    const F s2 = s * s;
    F y = fused(s2, F(0.32059889f), F(0.41219858f));  // 2 / ln 2 / 9, / 7, / 5, / 3, / 1
    y = fused(y, s2, F(0.57707802f));
    y = fused(y, s2, F(0.96179669f));
    y = fused(y, s2, F(2.88539008f));
    return fused(y, s, whole);
}

template <class F>
struct Vec {
    F x, y, z;
};
template <class F>
PCB_FN F dot(Vec<F> a, Vec<F> b) {
    return fused(a.x, b.x, fused(a.y, b.y, a.z * b.z));
}
template <class F>
PCB_FN Vec<F> cross(Vec<F> a, Vec<F> b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class F>
PCB_FN Vec<F> operator*(F s, Vec<F> a) {
    return {s * a.x, s * a.y, s * a.z};
}
template <class F>
PCB_FN Vec<F> operator+(Vec<F> a, Vec<F> b) {
    return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class F>
PCB_FN Vec<F> operator-(Vec<F> a, Vec<F> b) {
    return {a.x - b.x, a.y - b.y, a.z - b.z};
}
// a + s b
template <class F>
PCB_FN Vec<F> fused(F s, Vec<F> b, Vec<F> a) {
    return {fused(s, b.x, a.x), fused(s, b.y, a.y), fused(s, b.z, a.z)};
}
template <class M, class F>
PCB_FN Vec<F> select(M mask, Vec<F> yes, Vec<F> no) {
    return {select(mask, yes.x, no.x), select(mask, yes.y, no.y), select(mask, yes.z, no.z)};
}

// ---- the camera: a pinhole (pinhole.h)

template <class F>
PCB_FN Vec<F> to_camera(const Pinhole& at, Vec<F> p) {
    const float* r = at.rotation;
    return {fused(F(r[0]), p.x, fused(F(r[1]), p.y, F(r[2]) * p.z)),
            fused(F(r[3]), p.x, fused(F(r[4]), p.y, F(r[5]) * p.z)),
            fused(F(r[6]), p.x, fused(F(r[7]), p.y, F(r[8]) * p.z))};
}
template <class F>
PCB_FN Vec<F> to_world(const Pinhole& at, Vec<F> p) {
    const float* r = at.rotation;
    return {fused(F(r[0]), p.x, fused(F(r[3]), p.y, F(r[6]) * p.z)),
            fused(F(r[1]), p.x, fused(F(r[4]), p.y, F(r[7]) * p.z)),
            fused(F(r[2]), p.x, fused(F(r[5]), p.y, F(r[8]) * p.z))};
}

// ---- a Gaussian in space and its footprint in the image

template <class F>
struct Quaternion {
    F w, x, y, z;
};

// The columns of the rotation matrix of a unit quaternion.
template <class F>
PCB_FN void columns(Quaternion<F> q, Vec<F>* column) {
    const F two = F(2.0f), one = F(1.0f);
    column[0] = {one - two * (q.y * q.y + q.z * q.z), two * (q.x * q.y + q.w * q.z), two * (q.x * q.z - q.w * q.y)};
    column[1] = {two * (q.x * q.y - q.w * q.z), one - two * (q.x * q.x + q.z * q.z), two * (q.y * q.z + q.w * q.x)};
    column[2] = {two * (q.x * q.z + q.w * q.y), two * (q.y * q.z - q.w * q.x), one - two * (q.x * q.x + q.y * q.y)};
}

// The gradient with respect to the unit quaternion, from those with respect to the columns.
template <class F>
PCB_FN Quaternion<F> columns_gradient(Quaternion<F> q, const Vec<F>* g) {
    const F two = F(2.0f);
    const F xy = g[0].y + g[1].x, xz = g[0].z + g[2].x, yz = g[1].z + g[2].y;
    const F turn_x = g[1].z - g[2].y, turn_y = g[2].x - g[0].z, turn_z = g[0].y - g[1].x;
    return {two * (q.x * turn_x + q.y * turn_y + q.z * turn_z),
            two * (q.y * xy + q.z * xz + q.w * turn_x - two * q.x * (g[1].y + g[2].z)),
            two * (q.x * xy + q.z * yz + q.w * turn_y - two * q.y * (g[0].x + g[2].z)),
            two * (q.x * xz + q.y * yz + q.w * turn_z - two * q.z * (g[0].x + g[1].y))};
}

// A projected Gaussian. At a pixel with offset dx, dy from the projected mean its whitened coordinates are
// u = uu dx + uv dy, v = vv dy; alpha = 2^(level - u^2 - v^2); the depth of its plane is depth + depth_u u + depth_v v.
template <class F>
struct Splat {
    F x, y;
    F uu, uv, vv;
    F level;  // log2 of the opacity
    Vec<F> color;
    F depth, depth_u, depth_v;
    Vec<F> normal;  // unit length, in the camera's frame, towards the camera
};

// The intermediate values of a projection that its gradient uses again.
template <class F>
struct Footprint {
    Vec<F> offset;               // from the camera to the mean, in the world
    Vec<F> center;               // the mean in the camera's frame
    Quaternion<F> turn;          // the unit quaternion
    F turn_length;               // norm of the given quaternion
    Vec<F> direction[3];         // unit axes in the camera's frame
    Vec<F> axis[3];              // the same times the scale
    F slope_x, slope_y;          // x / z and y / z at the centre of the affine approximation
    Vec<F> row_x, row_y, row_z;  // the three axes in pixels across, in pixels down and in depth
    Vec<F> normal_xy;            // row_x x row_y
    F xx, xy, yy;                // the dilated covariance in pixels
    F determinant;
    F depth_across;
    F depth_x, depth_y;        // the covariances of depth with pixels across and down
    F shortest_0, shortest_1;  // 1 if axis 0 (1) is the shortest, else 0; if both are 0, it is axis 2
    F facing;                  // 1 or -1, turns the shortest axis towards the camera
    F reach;                   // u^2 + v^2 at the ellipse's edge, where alpha is min_alpha; negative if it never is
    F extent_x, extent_y;      // half the size of the ellipse's bounding box, pixels
};

// Returns the splat without its colour. If the mask `drawn` is false, the Gaussian must not be drawn and its values may
// be NaN: it is nearer than `nearest`, its opacity is too low, its rotation is undefined, or it is too large for the
// square of its size in a float (about 1e9 pixels).
template <class F, class M>
PCB_FN Splat<F> project(const Pinhole& at, Vec<F> mean, Quaternion<F> quaternion, Vec<F> scale, F opacity,
                        Footprint<F>& f, M& drawn) {
    const F zero = F(0.0f), one = F(1.0f);
    f.offset = {mean.x - F(at.position[0]), mean.y - F(at.position[1]), mean.z - F(at.position[2])};
    f.center = to_camera(at, f.offset);
    const F square =
        fused(quaternion.w, quaternion.w,
              fused(quaternion.x, quaternion.x, fused(quaternion.y, quaternion.y, quaternion.z * quaternion.z)));
    drawn = (F(at.nearest) < f.center.z) & (F(at.min_alpha) < opacity) & (F(kMinSquaredQuaternion) < square);
    // The lanes that are not drawn continue with harmless values, so nothing divides by zero.
    const F z = select(drawn, f.center.z, one);
    f.center.z = z;
    f.turn_length = root(select(drawn, square, one));
    const F shorter = one / f.turn_length;
    f.turn = {quaternion.w * shorter, quaternion.x * shorter, quaternion.y * shorter, quaternion.z * shorter};
    Vec<F> column[3];
    columns(f.turn, column);
    for (int k = 0; k < 3; ++k) f.direction[k] = to_camera(at, column[k]);
    f.axis[0] = scale.x * f.direction[0];
    f.axis[1] = scale.y * f.direction[1];
    f.axis[2] = scale.z * f.direction[2];

    const F per_z = one / z, x = f.center.x * per_z, y = f.center.y * per_z;
    f.slope_x = lesser(greater(x, F(at.left)), F(at.right));
    f.slope_y = lesser(greater(y, F(at.top)), F(at.bottom));
    const F zoom_x = F(at.fx) * per_z, zoom_y = F(at.fy) * per_z;
    f.row_z = {f.axis[0].z, f.axis[1].z, f.axis[2].z};
    f.row_x = zoom_x * (Vec<F>{f.axis[0].x, f.axis[1].x, f.axis[2].x} - f.slope_x * f.row_z);
    f.row_y = zoom_y * (Vec<F>{f.axis[0].y, f.axis[1].y, f.axis[2].y} - f.slope_y * f.row_z);
    f.normal_xy = cross(f.row_x, f.row_y);
    const F xx = dot(f.row_x, f.row_x), yy = dot(f.row_y, f.row_y);
    f.xx = xx + F(kDilation);
    f.yy = yy + F(kDilation);
    f.xy = dot(f.row_x, f.row_y);
    // The determinant of a needle's covariance is a small difference of large terms. Lagrange's identity avoids the
    // difference.
    f.determinant = dot(f.normal_xy, f.normal_xy) + fused(F(kDilation), xx + yy, F(kDilation * kDilation));
    drawn = drawn & (f.determinant < F(kMaxDeterminant));  // false for NaN
    f.depth_x = dot(f.row_z, f.row_x);
    f.depth_y = dot(f.row_z, f.row_y);
    // (depth_x - lean depth_y), whose terms nearly cancel for a needle: times yy, by the Binet-Cauchy identity.
    f.depth_across = fused(F(kDilation), f.depth_x, dot(cross(f.row_z, f.row_y), f.normal_xy)) / f.yy;

    Splat<F> s;
    s.x = fused(F(at.fx), x, F(at.cx));
    s.y = fused(F(at.fy), y, F(at.cy));
    const F steep = root(f.yy / f.determinant), lean = f.xy / f.yy, flat = one / root(f.yy);
    s.uu = F(kWhitening) * steep;
    s.uv = -(s.uu * lean);
    s.vv = F(kWhitening) * flat;
    s.level = log2_of(select(drawn, opacity, one));
    s.depth = z;
    // The conditional mean of the depth at a pixel: linear regression on (u, v).
    s.depth_u = F(1.0f / kWhitening) * (steep * f.depth_across);
    s.depth_v = F(1.0f / kWhitening) * (flat * f.depth_y);

    const auto first = (scale.x < scale.y) & (scale.x < scale.z);
    f.shortest_0 = select(first, one, zero);
    f.shortest_1 = select(first, zero, select(scale.y < scale.z, one, zero));
    const Vec<F> shortest = select(first, f.direction[0], select(scale.y < scale.z, f.direction[1], f.direction[2]));
    f.facing = select(zero < dot(shortest, f.center), F(-1.0f), one);
    s.normal = f.facing * shortest;

    f.reach = s.level - F(at.min_level);
    const F deviations = root(greater(f.reach, zero)) * F(1.0f / kWhitening);
    f.extent_x = deviations * root(f.xx);
    f.extent_y = deviations * root(f.yy);
    return s;
}

// The minimum of u^2 + v^2 within a box of offsets from the mean: if it exceeds the reach, the Gaussian touches no
// pixel of the box. The minimum of a convex function over a box without its centre lies on an edge that faces the
// centre.
template <class F>
PCB_FN F min_squared_norm(F uu, F uv, F vv, F x0, F x1, F y0, F y1) {
    const F zero = F(0.0f);
    const F dx = lesser(greater(zero, x0), x1), dy = lesser(greater(zero, y0), y1);
    // Both quotients are the same for all boxes of a splat.
    const F along_y = -(uu * uv / (uv * uv + vv * vv)) * dx, along_x = -(uv / uu) * dy;
    const F y = lesser(greater(along_y, y0), y1), x = lesser(greater(along_x, x0), x1);
    const F u_at_x = fused(uu, dx, uv * y), v_at_x = vv * y;
    const F u_at_y = fused(uu, x, uv * dy), v_at_y = vv * dy;
    return lesser(fused(u_at_x, u_at_x, v_at_x * v_at_x), fused(u_at_y, u_at_y, v_at_y * v_at_y));
}

// ---- a splat at a pixel

template <class F>
PCB_FN F alpha_at(F level, F u, F v) {
    // The exponent is clamped where its power is still a normal float, far below any min_alpha.
    return exp2_of(greater(fused(-u, u, fused(-v, v, level)), F(-64.0f)));
}

// The gradient of the loss with respect to the images at a pixel.
template <class F>
struct PixelGradient {
    Vec<F> color;
    F depth;  // with respect to the sum of weight times depth
    Vec<F> normal;
};

// Sums over pixels from which the gradient with respect to a splat is computed. h is alpha times the gradient with
// respect to alpha.
template <class F>
struct Moments {
    F h, hu, hv, huu, huv, hvv;
    Vec<F> color;
    F depth, depth_u, depth_v;  // sums of weight times the gradient with respect to depth, times 1, u, v
    Vec<F> normal;
};

// Adds the contribution of one pixel. `alpha` is 0 if the splat is skipped, else at most kMaxAlpha; `unclamped` is
// false if alpha was clamped to that maximum; `transmittance` is the transmittance in front of the splat. `behind` is
// the sum, over this and all later splats, of weight times the gradient with respect to the weight, plus the
// contribution of the background. The gradient of the loss with respect to alpha is transmittance * grad_weight -
// behind / (1 - alpha), with `behind` after the contribution of this splat has been subtracted.
template <int kGeometry, class F, class M>
PCB_FN void add_pixel(const Splat<F>& s, F u, F v, F alpha, M unclamped, F transmittance, const PixelGradient<F>& g,
                      F& behind, Moments<F>& m) {
    const F weight = alpha * transmittance;
    F grad_weight = dot(s.color, g.color);
    if (kGeometry >= kDepth)
        grad_weight = fused(fused(s.depth_u, u, fused(s.depth_v, v, s.depth)), g.depth, grad_weight);
    if (kGeometry >= kNormals) grad_weight = grad_weight + dot(s.normal, g.normal);
    const F part = weight * grad_weight;
    behind = behind - part;
    const F h = select(unclamped, fused(-behind, alpha / (F(1.0f) - alpha), part), F(0.0f));
    const F hu = h * u, hv = h * v;
    m.h = m.h + h;
    m.hu = m.hu + hu;
    m.hv = m.hv + hv;
    m.huu = fused(hu, u, m.huu);
    m.huv = fused(hu, v, m.huv);
    m.hvv = fused(hv, v, m.hvv);
    m.color = fused(weight, g.color, m.color);
    if (kGeometry >= kDepth) {
        const F d = weight * g.depth;
        m.depth = m.depth + d;
        m.depth_u = fused(d, u, m.depth_u);
        m.depth_v = fused(d, v, m.depth_v);
    }
    if (kGeometry >= kNormals) m.normal = fused(weight, g.normal, m.normal);
}

// ---- from the pixels back to the Gaussian

template <class F>
struct Gradient {
    Vec<F> mean, scale;
    Quaternion<F> quaternion;
    F opacity;
    F screen_x, screen_y;  // with respect to the projected mean, per pixel
};

// The gradient with respect to the Gaussian, without the dependence of its colour on the mean through the view
// direction.
template <class F>
PCB_FN Gradient<F> project_gradient(const Pinhole& at, Vec<F> scale, F opacity, const Footprint<F>& f,
                                    const Splat<F>& s, const Moments<F>& m) {
    const F zero = F(0.0f), one = F(1.0f);
    Gradient<F> out;
    out.opacity = m.h / opacity;

    // With respect to u and v, summed over the pixels, plain and times u or v. The exponent's derivative is -2 u (-2
    // v).
    const F factor = F(-2.0f * kLn2);
    const F grad_u = fused(factor, m.hu, s.depth_u * m.depth), grad_v = fused(factor, m.hv, s.depth_v * m.depth);
    const F grad_u_u = fused(factor, m.huu, s.depth_u * m.depth_u),
            grad_u_v = fused(factor, m.huv, s.depth_u * m.depth_v);
    const F grad_v_v = fused(factor, m.hvv, s.depth_v * m.depth_v);
    out.screen_x = -(s.uu * grad_u);
    out.screen_y = -fused(s.uv, grad_u, s.vv * grad_v);

    // With respect to the whitening. An offset is dy = v / vv, dx = (u - uv dy) / uu.
    const F g_uv = grad_u_v / s.vv, g_vv = grad_v_v / s.vv, g_uu = (grad_u_u - s.uv * g_uv) / s.uu;

    // uu = k steep, uv = -uu lean, vv = k flat; depth_u = steep (depth_x - lean depth_y) / k, depth_v = flat depth_y /
    // k.
    const F steep = F(1.0f / kWhitening) * s.uu, flat = F(1.0f / kWhitening) * s.vv, lean = f.xy / f.yy;
    const F g_du = F(1.0f / kWhitening) * m.depth_u, g_dv = F(1.0f / kWhitening) * m.depth_v;
    const F g_steep = F(kWhitening) * (g_uu - lean * g_uv) + f.depth_across * g_du;
    const F g_flat = F(kWhitening) * g_vv + f.depth_y * g_dv;
    const F g_lean = -(s.uu * g_uv + steep * f.depth_y * g_du);
    const F g_depth_x = steep * g_du;
    const F g_depth_y = flat * g_dv - lean * g_depth_x;

    // steep = sqrt(yy / determinant), flat = 1 / sqrt(yy), lean = xy / yy.
    const F half_steep = F(0.5f) * steep * g_steep;
    const F g_determinant = -(half_steep / f.determinant);
    const F g_xy = g_lean / f.yy;
    const F g_yy = (half_steep - F(0.5f) * flat * g_flat - lean * g_lean) / f.yy;

    // xx occurs in the determinant only.
    const F twice = F(2.0f) * g_determinant;
    Vec<F> g_row_x = twice * fused(F(kDilation), f.row_x, cross(f.row_y, f.normal_xy));
    Vec<F> g_row_y = twice * fused(F(kDilation), f.row_y, cross(f.normal_xy, f.row_x));
    g_row_x = fused(g_depth_x, f.row_z, fused(g_xy, f.row_y, g_row_x));
    g_row_y = fused(g_depth_y, f.row_z, fused(g_xy, f.row_x, fused(F(2.0f) * g_yy, f.row_y, g_row_y)));
    Vec<F> g_row_z = fused(g_depth_x, f.row_x, g_depth_y * f.row_y);

    // row_x = fx / z (x of the axes - slope_x row_z), row_y likewise.
    const F per_z = one / f.center.z, zoom_x = F(at.fx) * per_z, zoom_y = F(at.fy) * per_z;
    const Vec<F> g_across = zoom_x * g_row_x, g_down = zoom_y * g_row_y;
    g_row_z = g_row_z - fused(f.slope_x, g_across, f.slope_y * g_down);
    const F g_slope_x = -dot(g_across, f.row_z), g_slope_y = -dot(g_down, f.row_z);
    F g_z = m.depth - per_z * (dot(g_row_x, f.row_x) + dot(g_row_y, f.row_y));

    // The mean: x / z moves the projected mean, and the affine approximation unless its centre is clamped.
    const F x = f.center.x * per_z, y = f.center.y * per_z;
    const auto free_x = (F(at.left) < x) & (x < F(at.right)), free_y = (F(at.top) < y) & (y < F(at.bottom));
    const F g_x = fused(F(at.fx), out.screen_x, select(free_x, g_slope_x, zero));
    const F g_y = fused(F(at.fy), out.screen_y, select(free_y, g_slope_y, zero));
    g_z = g_z - per_z * fused(g_x, x, g_y * y);
    out.mean = to_world(at, Vec<F>{per_z * g_x, per_z * g_y, g_z});

    const Vec<F> g_axis[3] = {
        {g_across.x, g_down.x, g_row_z.x}, {g_across.y, g_down.y, g_row_z.y}, {g_across.z, g_down.z, g_row_z.z}};
    out.scale = {dot(g_axis[0], f.direction[0]), dot(g_axis[1], f.direction[1]), dot(g_axis[2], f.direction[2])};

    const F shortest[3] = {f.shortest_0, f.shortest_1, one - f.shortest_0 - f.shortest_1};
    const F along[3] = {scale.x, scale.y, scale.z};
    Vec<F> g_column[3];
    for (int k = 0; k < 3; ++k)
        g_column[k] = to_world(at, fused(shortest[k] * f.facing, m.normal, along[k] * g_axis[k]));
    const Quaternion<F> t = f.turn, g = columns_gradient(t, g_column);
    const F radial = fused(t.w, g.w, fused(t.x, g.x, fused(t.y, g.y, t.z * g.z))), shorter = one / f.turn_length;
    out.quaternion = {shorter * (g.w - radial * t.w), shorter * (g.x - radial * t.x), shorter * (g.y - radial * t.y),
                      shorter * (g.z - radial * t.z)};
    return out;
}

// ---- colour: real spherical harmonics in the 3DGS order and signs

// The first `count` (1, 4, 9 or 16) spherical harmonics in a unit direction.
template <class F>
PCB_FN void harmonics(Vec<F> d, int count, F* basis) {
    basis[0] = F(0.282094792f);
    if (count < 4) return;
    const F x = d.x, y = d.y, z = d.z;
    basis[1] = F(-0.488602512f) * y;
    basis[2] = F(0.488602512f) * z;
    basis[3] = F(-0.488602512f) * x;
    if (count < 9) return;
    const F xx = x * x, yy = y * y, zz = z * z;
    basis[4] = F(1.09254843f) * x * y;
    basis[5] = F(-1.09254843f) * y * z;
    basis[6] = F(0.315391565f) * (zz + zz - xx - yy);
    basis[7] = F(-1.09254843f) * x * z;
    basis[8] = F(0.546274215f) * (xx - yy);
    if (count < 16) return;
    const F four = F(4.0f) * zz - xx - yy, three = F(3.0f);
    basis[9] = F(-0.590043590f) * y * (three * xx - yy);
    basis[10] = F(2.89061144f) * x * y * z;
    basis[11] = F(-0.457045799f) * y * four;
    basis[12] = F(0.373176333f) * z * (zz + zz - three * (xx + yy));
    basis[13] = F(-0.457045799f) * x * four;
    basis[14] = F(1.44530572f) * z * (xx - yy);
    basis[15] = F(-0.590043590f) * x * (xx - three * yy);
}

// The gradient of the sum of g[k] basis[k] with respect to the direction, ignoring its unit norm.
template <class F>
PCB_FN Vec<F> harmonics_gradient(Vec<F> d, int count, const F* g) {
    const F zero = F(0.0f);
    if (count < 4) return {zero, zero, zero};
    const F x = d.x, y = d.y, z = d.z;
    Vec<F> out = {F(-0.488602512f) * g[3], F(-0.488602512f) * g[1], F(0.488602512f) * g[2]};
    if (count < 9) return out;
    const F a4 = F(1.09254843f) * g[4], a5 = F(-1.09254843f) * g[5], a6 = F(0.630783131f) * g[6],
            a7 = F(-1.09254843f) * g[7], a8 = F(1.09254843f) * g[8];
    out = out + Vec<F>{a4 * y - a6 * x + a7 * z + a8 * x, a4 * x + a5 * z - a6 * y - a8 * y,
                       a5 * y + F(2.0f) * a6 * z + a7 * x};
    if (count < 16) return out;
    const F xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
    const F two = F(2.0f), three = F(3.0f), six = F(6.0f), eight = F(8.0f);
    const F a9 = F(-0.590043590f) * g[9], a10 = F(2.89061144f) * g[10], a11 = F(-0.457045799f) * g[11],
            a12 = F(0.373176333f) * g[12], a13 = F(-0.457045799f) * g[13], a14 = F(1.44530572f) * g[14],
            a15 = F(-0.590043590f) * g[15];
    const F grad_x = a9 * (six * xy) + a10 * yz - a11 * (two * xy) - a12 * (six * xz) +
                     a13 * (F(4.0f) * zz - three * xx - yy) + a14 * (two * xz) + a15 * (three * (xx - yy));
    const F grad_y = a9 * (three * (xx - yy)) + a10 * xz + a11 * (F(4.0f) * zz - xx - three * yy) - a12 * (six * yz) -
                     a13 * (two * xy) - a14 * (two * yz) - a15 * (six * xy);
    const F grad_z =
        a10 * xy + a11 * (eight * yz) + a12 * (six * zz - three * (xx + yy)) + a13 * (eight * xz) + a14 * (xx - yy);
    return out + Vec<F>{grad_x, grad_y, grad_z};
}

// The unit vector along `offset`, and the gradient with respect to the offset from that with respect to the unit
// vector.
template <class F>
PCB_FN Vec<F> unit(Vec<F> offset) {
    return (F(1.0f) / root(dot(offset, offset))) * offset;
}
template <class F>
PCB_FN Vec<F> unit_gradient(Vec<F> offset, Vec<F> g) {
    const F shorter = F(1.0f) / root(dot(offset, offset));
    const Vec<F> d = shorter * offset;
    return shorter * (g - dot(d, g) * d);
}
