// Computes the basis of spherical harmonics of one Gaussian, and its backward (method, section 1), on CPUs and GPUs.
// Normalisation, signs and order are those of core/sh.py.
#pragma once

#include <math.h>

#include "ops/kernels.h"
#include "simd/device.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

constexpr double kC0 = 0.28209479177387814, kC1 = 0.4886025119029199;
constexpr double kC20 = 1.0925484305920792, kC21 = 0.31539156525252005, kC22 = 0.5462742152960396;
constexpr double kC30 = 0.5900435899266435, kC31 = 2.890611442640554, kC32 = 0.4570457994644658,
                 kC33 = 0.3731763325901154, kC34 = 1.445305721320277;
constexpr double kLeastDistance = 1e-12;  // distance that a Gaussian at the camera is taken to have

template <class T>
struct Direction {
  T x, y, z, inverse;  // unit vector, and 1 / distance
};

template <class T>
BEAGS_HD_INLINE Direction<T> direction(const ColorJob<T>& job, int64_t i) {
  const T x = job.means[3 * i] - job.center[0], y = job.means[3 * i + 1] - job.center[1];
  const T z = job.means[3 * i + 2] - job.center[2], least = static_cast<T>(kLeastDistance);
  const T length = static_cast<T>(::sqrt(x * x + y * y + z * z));
  const T inverse = T(1) / (length < least ? least : length);
  return {x * inverse, y * inverse, z * inverse, inverse};
}

// Calls put(k, value) for each function k of the basis.
template <int kDegree, class T, class Put>
BEAGS_HD_INLINE void basis(const Direction<T>& d, Put put) {
  const T x = d.x, y = d.y, z = d.z;
  put(0, T(kC0));
  if (kDegree >= 1) {
    put(1, -T(kC1) * y);
    put(2, T(kC1) * z);
    put(3, -T(kC1) * x);
  }
  if (kDegree >= 2) {
    put(4, T(kC20) * x * y);
    put(5, -T(kC20) * y * z);
    put(6, T(kC21) * (3 * z * z - 1));
    put(7, -T(kC20) * x * z);
    put(8, T(kC22) * (x * x - y * y));
  }
  if (kDegree >= 3) {
    put(9, -T(kC30) * y * (3 * x * x - y * y));
    put(10, T(kC31) * x * y * z);
    put(11, -T(kC32) * y * (5 * z * z - 1));
    put(12, T(kC33) * z * (5 * z * z - 3));
    put(13, -T(kC32) * x * (5 * z * z - 1));
    put(14, T(kC34) * z * (x * x - y * y));
    put(15, -T(kC30) * x * (x * x - 3 * y * y));
  }
}

template <class T>
struct DirectionGradient {
  T x, y, z;
};

// Adds the part of degree kDegree (1 or more) to the gradient of the direction. g(k): the gradient of function k of the
// basis.
template <int kDegree, class T, class Get>
BEAGS_HD_INLINE DirectionGradient<T> basis_backward(const Direction<T>& d, Get g) {
  const T x = d.x, y = d.y, z = d.z;
  if constexpr (kDegree == 1) return {-T(kC1) * g(3), -T(kC1) * g(1), T(kC1) * g(2)};
  if constexpr (kDegree == 2) {
    return {T(kC20) * (y * g(4) - z * g(7)) + T(2 * kC22) * x * g(8),
            T(kC20) * (x * g(4) - z * g(5)) - T(2 * kC22) * y * g(8),
            -T(kC20) * (y * g(5) + x * g(7)) + T(6 * kC21) * z * g(6)};
  }
  const T xx = x * x, yy = y * y, zz = z * z;
  return {-T(6 * kC30) * x * y * g(9) + T(kC31) * y * z * g(10) - T(kC32) * (5 * zz - 1) * g(13) +
              T(2 * kC34) * x * z * g(14) - T(3 * kC30) * (xx - yy) * g(15),
          -T(3 * kC30) * (xx - yy) * g(9) + T(kC31) * x * z * g(10) - T(kC32) * (5 * zz - 1) * g(11) -
              T(2 * kC34) * y * z * g(14) + T(6 * kC30) * x * y * g(15),
          T(kC31) * x * y * g(10) - T(10 * kC32) * z * (y * g(11) + x * g(13)) + T(kC33) * (15 * zz - 3) * g(12) +
              T(kC34) * (xx - yy) * g(14)};
}

// Computes the gradient of a mean, to[3]: d = p / |p|, where |p| is at least kLeastDistance.
template <class T>
BEAGS_HD_INLINE void to_mean(const Direction<T>& d, const DirectionGradient<T>& g, T* to) {
  T along = g.x * d.x + g.y * d.y + g.z * d.z;
  if (d.inverse >= T(1 / kLeastDistance)) along = 0;
  to[0] = (g.x - along * d.x) * d.inverse;
  to[1] = (g.y - along * d.y) * d.inverse;
  to[2] = (g.z - along * d.z) * d.inverse;
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
