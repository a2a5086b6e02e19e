// A thread a drawn Gaussian: adds the records of its instances in the order in which they were written, and goes back
// from the pixels to what was given. Row by row as `ids`.

constexpr int kMoments = kGeometry ? 17 : 11;

extern "C" __global__ void __launch_bounds__(kThreads)
    project_backward(const Pinhole* camera, int count, const long long* ids, const int* firsts, const int* tiles,
                     const float* means, const float* quaternions, const float* scales, const float* opacities,
                     const float* coefficients, const Stored* splats, const float* records, float* by_means,
                     float* by_quaternions, float* by_scales, float* by_opacities, float* by_coefficients,
                     float* by_screen, float* weights, float* errors) {
    const long long row = static_cast<long long>(blockIdx.x) * kThreads + threadIdx.x;  // times 3 and 4 below
    if (row >= count) return;
    const Pinhole at = *camera;
    const long long id = ids[row];

    float sum[17] = {};
    const float* record = records + static_cast<long long>(firsts[row]) * kMoments;
    for (int n = tiles[id]; n > 0; --n, record += kMoments)
        for (int k = 0; k < kMoments; ++k) sum[k] = sum[k] + record[k];
    Moments<float> m = {};
    m.h = sum[0], m.hu = sum[1], m.hv = sum[2], m.huu = sum[3], m.huv = sum[4], m.hvv = sum[5];
    m.color = {sum[6], sum[7], sum[8]}, m.weight = sum[9], m.error = sum[10];
    if (kGeometry) {
        m.depth = sum[11], m.depth_u = sum[12], m.depth_v = sum[13];
        m.normal = {sum[14], sum[15], sum[16]};
    }

    const Given g = given_at(id, means, quaternions, scales, opacities);
    Footprint<float> f;
    bool drawn;
    const Splat<float> s = project(at, g.mean, g.quaternion, g.scale, g.opacity, f, drawn);
    Gradient<float> out = project_gradient(at, g.scale, g.opacity, f, s, m);

    // Where a colour was held at zero it has no derivative.
    const Vec<float> shown = splats[id].splat.color;
    const Vec<float> by_color = {select(0.0f < shown.x, m.color.x, 0.0f), select(0.0f < shown.y, m.color.y, 0.0f),
                                 select(0.0f < shown.z, m.color.z, 0.0f)};
    const Vec<float> direction = unit(f.offset);
    float basis[kMaxHarmonics], by_basis[kMaxHarmonics];
    harmonics(direction, kHarmonics, basis);
    const float* c = coefficients + 3LL * kHarmonics * id;
    float* by_c = by_coefficients + 3LL * kHarmonics * row;
    for (int k = 0; k < kHarmonics; ++k) {
        by_basis[k] = dot(Vec<float>{c[3 * k], c[3 * k + 1], c[3 * k + 2]}, by_color);
        by_c[3 * k] = basis[k] * by_color.x, by_c[3 * k + 1] = basis[k] * by_color.y,
                 by_c[3 * k + 2] = basis[k] * by_color.z;
    }
    out.mean = out.mean + unit_gradient(f.offset, harmonics_gradient(direction, kHarmonics, by_basis));

    by_means[3 * row] = out.mean.x, by_means[3 * row + 1] = out.mean.y, by_means[3 * row + 2] = out.mean.z;
    by_scales[3 * row] = out.scale.x, by_scales[3 * row + 1] = out.scale.y, by_scales[3 * row + 2] = out.scale.z;
    by_quaternions[4 * row] = out.quaternion.w, by_quaternions[4 * row + 1] = out.quaternion.x;
    by_quaternions[4 * row + 2] = out.quaternion.y, by_quaternions[4 * row + 3] = out.quaternion.z;
    by_opacities[row] = out.opacity;
    by_screen[2 * row] = out.screen_x, by_screen[2 * row + 1] = out.screen_y;
    weights[row] = m.weight;
    errors[row] = m.error;
}
