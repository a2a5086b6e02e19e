// Smallest eigenvalues and eigenvectors of eight symmetric 3x3 matrices at once, by Jacobi rotations (jacobi.h).
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include "common/jacobi.h"
#include "common/simd.h"

namespace pcbench::PCB_ISA {

struct SmallestEigen {
    Vector x, y, z;  // unit vector
    Vector share;    // smallest eigenvalue divided by the sum of all three; 0 for a zero matrix
};

// Rotates the matrices that have not converged; converged ones (`done`) keep their bits.
inline void rotate(Vector& pp, Vector& qq, Vector& pq, Vector& rp, Vector& rq, Vector (&vp)[3], Vector (&vq)[3],
                   Mask done) {
    const Vector zero = splat(0.0), one = splat(1.0), two = splat(2.0);
    const Vector difference = qq - pp, twice = two * pq;
    const Vector root = sqrt(difference * difference + twice * twice);
    const Vector signed_twice = select(difference < zero, zero - twice, twice);
    const Vector tangent = select(done | (pq == zero), zero, signed_twice / (abs(difference) + root));
    rotate_axes(tangent, one, pp, qq, pq, rp, rq, vp, vq);
    pq = select(done, pq, zero);
}

inline SmallestEigen smallest_eigen(Symmetric<Vector> m) {
    const Vector zero = splat(0.0), one = splat(1.0);
    // Scaling to a trace of one avoids overflow, and underflow that matters.
    const Vector trace = (m.xx + m.yy) + m.zz;
    const Vector scale = select(zero < trace, one / trace, zero);
    m = {m.xx * scale, m.xy * scale, m.xz * scale, m.yy * scale, m.yz * scale, m.zz * scale};
    Vector v[3][3] = {{one, zero, zero}, {zero, one, zero}, {zero, zero, one}};  // one axis per row
    for (int round = 0; round < 16; ++round) {
        const Mask done = (abs(m.xy) + abs(m.xz)) + abs(m.yz) <= splat(1e-17);
        if (bits(done) == 0xff) break;
        jacobi_sweep(
            m, v, [done](Vector& pp, Vector& qq, Vector& pq, Vector& rp, Vector& rq, Vector(&vp)[3], Vector(&vq)[3]) {
                rotate(pp, qq, pq, rp, rq, vp, vq, done);
            });
    }
    SmallestEigen out{v[0][0], v[0][1], v[0][2], m.xx};
    for (int axis = 1; axis < 3; ++axis) {
        const Vector value = axis == 1 ? m.yy : m.zz;
        const Mask smaller = value < out.share;
        out.share = select(smaller, value, out.share);
        out.x = select(smaller, v[axis][0], out.x);
        out.y = select(smaller, v[axis][1], out.y);
        out.z = select(smaller, v[axis][2], out.z);
    }
    const Vector length = sqrt(squared_length(out.x, out.y, out.z));
    return {out.x / length, out.y / length, out.z / length, max(out.share, zero)};
}

}  // namespace pcbench::PCB_ISA
