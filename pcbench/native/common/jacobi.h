// Symmetric 3x3 eigenproblems by cyclic Jacobi rotations (Golub and Van Loan, Matrix Computations, section 8.5), in
// doubles or SIMD vectors. The closed form is faster but loses half of the digits for the nearly singular covariances
// of planes.
#pragma once
#include <cmath>

namespace pcbench {

template <typename Number>
struct Symmetric {
    Number xx, xy, xz, yy, yz, zz;
};

// Rotates axes p and q by the angle whose tangent makes a_pq vanish; the caller sets a_pq to zero. r is the third axis.
template <typename Number>
inline void rotate_axes(Number tangent, Number one, Number& pp, Number& qq, const Number& pq, Number& rp, Number& rq,
                        Number (&vp)[3], Number (&vq)[3]) {
    using std::sqrt;  // the sqrt of SIMD vectors is found by argument-dependent lookup
    const Number c = one / sqrt(tangent * tangent + one), s = tangent * c;
    pp = pp - tangent * pq;
    qq = qq + tangent * pq;
    const Number p = rp, q = rq;
    rp = c * p - s * q;
    rq = s * p + c * q;
    for (int a = 0; a < 3; ++a) {
        const Number from_p = vp[a], from_q = vq[a];
        vp[a] = c * from_p - s * from_q;
        vq[a] = s * from_p + c * from_q;
    }
}

// Rotates every pair of axes once. `rotate` computes the tangent and rotates: doubles may skip entries that are zero,
// SIMD vectors cannot, so each has its own. `axes` holds one approximate eigenvector per row.
template <typename Number, typename Rotate>
inline void jacobi_sweep(Symmetric<Number>& m, Number (&axes)[3][3], Rotate rotate) {
    rotate(m.xx, m.yy, m.xy, m.xz, m.yz, axes[0], axes[1]);
    rotate(m.xx, m.zz, m.xz, m.xy, m.yz, axes[0], axes[2]);
    rotate(m.yy, m.zz, m.yz, m.xy, m.xz, axes[1], axes[2]);
}

}  // namespace pcbench
