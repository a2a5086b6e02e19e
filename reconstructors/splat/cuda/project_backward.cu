// The gradients with respect to a drawn Gaussian, one thread per Gaussian: adds the records of its instances in the
// order in which they were written, and applies the gradient of the projection. The rows are those of `ids`.

constexpr int kMoments = kMomentFloats[kGeometry];

extern "C" __global__ void __launch_bounds__(kThreads)
    project_backward(const Pinhole* camera, int count, const long long* ids, const int* firsts, const int* tiles,
                     const float* means, const float* quaternions, const float* scales, const float* opacities,
                     const float* coefficients, const Stored* splats, const float* records, float* grad_means,
                     float* grad_quaternions, float* grad_scales, float* grad_opacities, float* grad_coefficients,
                     float* grad_screen) {
    const long long row = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;  // 64 bits: used times 3 and 4
    if (row >= count) return;
    const Pinhole at = *camera;
    const long long id = ids[row];

    float sum[kMomentFloats[kNormals]] = {};
    const float* record = records + static_cast<long long>(firsts[row]) * kMoments;
    for (int n = tiles[id]; n > 0; --n, record += kMoments)
        for (int k = 0; k < kMoments; ++k) sum[k] = sum[k] + record[k];
    Moments<float> m = {};
    m.h = sum[0], m.hu = sum[1], m.hv = sum[2], m.huu = sum[3], m.huv = sum[4], m.hvv = sum[5];
    m.color = {sum[6], sum[7], sum[8]};
    m.depth = sum[9], m.depth_u = sum[10], m.depth_v = sum[11];
    m.normal = {sum[12], sum[13], sum[14]};

    const GaussianRow g = load_gaussian(id, means, quaternions, scales, opacities);
    Footprint<float> f;
    bool drawn;
    const Splat<float> s = project(at, g.mean, g.quaternion, g.scale, g.opacity, f, drawn);
    Gradient<float> out = project_gradient(at, g.scale, g.opacity, f, s, m);

    // A colour clamped at zero has no gradient.
    const Vec<float> color = splats[id].splat.color;
    const Vec<float> grad_color = {select(0.0f < color.x, m.color.x, 0.0f), select(0.0f < color.y, m.color.y, 0.0f),
                                   select(0.0f < color.z, m.color.z, 0.0f)};
    const Vec<float> direction = unit(f.offset);
    float basis[kMaxHarmonics], grad_basis[kMaxHarmonics];
    harmonics(direction, kHarmonics, basis);
    const float* c = coefficients + 3LL * kHarmonics * id;
    float* grad_c = grad_coefficients + 3LL * kHarmonics * row;
    for (int k = 0; k < kHarmonics; ++k) {
        grad_basis[k] = dot(Vec<float>{c[3 * k], c[3 * k + 1], c[3 * k + 2]}, grad_color);
        grad_c[3 * k] = basis[k] * grad_color.x, grad_c[3 * k + 1] = basis[k] * grad_color.y,
                   grad_c[3 * k + 2] = basis[k] * grad_color.z;
    }
    out.mean = out.mean + unit_gradient(f.offset, harmonics_gradient(direction, kHarmonics, grad_basis));

    grad_means[3 * row] = out.mean.x, grad_means[3 * row + 1] = out.mean.y, grad_means[3 * row + 2] = out.mean.z;
    grad_scales[3 * row] = out.scale.x, grad_scales[3 * row + 1] = out.scale.y, grad_scales[3 * row + 2] = out.scale.z;
    grad_quaternions[4 * row] = out.quaternion.w, grad_quaternions[4 * row + 1] = out.quaternion.x;
    grad_quaternions[4 * row + 2] = out.quaternion.y, grad_quaternions[4 * row + 3] = out.quaternion.z;
    grad_opacities[row] = out.opacity;
    grad_screen[2 * row] = out.screen_x, grad_screen[2 * row + 1] = out.screen_y;
}
