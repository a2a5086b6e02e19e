// Symmetric 3x3 eigenproblems by cyclic Jacobi rotations, in doubles or in SIMD vectors of them: slower than the closed
// form, but accurate to the last digits for the nearly singular covariances that planes have (the closed form loses
// half of them).
#pragma once
#include <cmath>

namespace pcbench {

template <typename Number>
struct Symmetric {
    Number xx, xy, xz, yy, yz, zz;
};

// Turns axes p and q by the angle whose tangent makes a_pq vanish; the caller sets a_pq to zero. r is the third axis.
template <typename Number>
inline void turn(Number tangent, Number one, Number& pp, Number& qq, const Number& pq, Number& rp, Number& rq,
                 Number (&vp)[3], Number (&vq)[3]) {
    using std::sqrt;  // that of SIMD vectors is found beside their type
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

// Every pair of axes once. `rotate` finds the tangent and turns: doubles may skip what is zero already, the numbers of
// one SIMD vector cannot, so each has its own. `axes` holds one eigenvector in the making a row.
template <typename Number, typename Rotate>
inline void sweep(Symmetric<Number>& m, Number (&axes)[3][3], Rotate rotate) {
    rotate(m.xx, m.yy, m.xy, m.xz, m.yz, axes[0], axes[1]);
    rotate(m.xx, m.zz, m.xz, m.xy, m.yz, axes[0], axes[2]);
    rotate(m.yy, m.zz, m.yz, m.xy, m.xz, axes[1], axes[2]);
}

}  // namespace pcbench
