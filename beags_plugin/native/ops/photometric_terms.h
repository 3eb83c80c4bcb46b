// Computes the SSIM index of one number and its slopes (method, section 1), for the vectors of CPUs and the threads of
// GPUs. R: T, or a vector of T.
#pragma once

#include "simd/device.h"
#if defined(__CUDACC__) || defined(BEAGS_CUDA_EMULATION)
#include "simd/scalar_math.h"
#else
#include "ops/lanes.h"
#endif

namespace beags {
namespace ops {
namespace BEAGS_ISA {

template <class R>
struct SsimTerms {
  R index, by_mean, by_squares, by_product;  // the index, and its slopes in blurred x, x^2 + y^2 and x y
};

// m_x, m_y, squares, product: blurred x, y, x^2 + y^2, x y.
template <class T, class R>
BEAGS_HD_INLINE SsimTerms<R> ssim_terms(R m_x, R m_y, R squares, R product, T c1, T c2) {
  const R m_xx_yy = fma(m_x, m_x, m_y * m_y), m_xy = m_x * m_y;
  const R a1 = T(2) * m_xy + c1, a2 = T(2) * (product - m_xy) + c2;
  const R b1 = m_xx_yy + c1, b2 = squares - m_xx_yy + c2;
  const R inverse = T(1) / (b1 * b2), index = a1 * a2 * inverse;
  return {index, T(2) * (m_y * (a2 - a1) + m_x * index * (b1 - b2)) * inverse, -index * (b1 * inverse),
          T(2) * a1 * inverse};
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
