// Colours from spherical harmonics of degree 0 to 3 (method, section 1), a block of surfels at a time: first the basis
// of all of them, then their sums. Included by the files that are compiled for one instruction set.
#pragma once

#include <math.h>

#include "op_kernels.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

// Normalisation, signs and order as core/sh.py.
constexpr double kC0 = 0.28209479177387814, kC1 = 0.4886025119029199;
constexpr double kC2[3] = {1.0925484305920792, 0.31539156525252005, 0.5462742152960396};
constexpr double kC3[5] = {0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154,
                           1.445305721320277};
constexpr double kLeastDistance = 1e-12;  // a surfel at the camera

template <class T>
struct Directions {
  T x[kColorBlock], y[kColorBlock], z[kColorBlock], inverse[kColorBlock];  // unit vectors, and 1 / distance
};

template <class T>
void directions(const ColorJob<T>& job, int64_t first, int count, Directions<T>& d) {
  for (int i = 0; i < count; ++i) {
    d.x[i] = job.means[3 * (first + i)] - job.center[0];
    d.y[i] = job.means[3 * (first + i) + 1] - job.center[1];
    d.z[i] = job.means[3 * (first + i) + 2] - job.center[2];
  }
  for (int i = 0; i < count; ++i) {
    const T length = static_cast<T>(::sqrt(d.x[i] * d.x[i] + d.y[i] * d.y[i] + d.z[i] * d.z[i]));
    const T least = static_cast<T>(kLeastDistance);
    d.inverse[i] = T(1) / (length < least ? least : length);
    d.x[i] *= d.inverse[i];
    d.y[i] *= d.inverse[i];
    d.z[i] *= d.inverse[i];
  }
}

template <class T>
void basis(int degree, int count, const Directions<T>& d, T (*b)[kColorBlock]) {
  for (int i = 0; i < count; ++i) b[0][i] = T(kC0);
  if (degree < 1) return;
  for (int i = 0; i < count; ++i) {
    b[1][i] = -T(kC1) * d.y[i];
    b[2][i] = T(kC1) * d.z[i];
    b[3][i] = -T(kC1) * d.x[i];
  }
  if (degree < 2) return;
  for (int i = 0; i < count; ++i) {
    const T x = d.x[i], y = d.y[i], z = d.z[i];
    b[4][i] = T(kC2[0]) * x * y;
    b[5][i] = -T(kC2[0]) * y * z;
    b[6][i] = T(kC2[1]) * (3 * z * z - 1);
    b[7][i] = -T(kC2[0]) * x * z;
    b[8][i] = T(kC2[2]) * (x * x - y * y);
  }
  if (degree < 3) return;
  for (int i = 0; i < count; ++i) {
    const T x = d.x[i], y = d.y[i], z = d.z[i];
    b[9][i] = -T(kC3[0]) * y * (3 * x * x - y * y);
    b[10][i] = T(kC3[1]) * x * y * z;
    b[11][i] = -T(kC3[2]) * y * (5 * z * z - 1);
    b[12][i] = T(kC3[3]) * z * (5 * z * z - 3);
    b[13][i] = -T(kC3[2]) * x * (5 * z * z - 1);
    b[14][i] = T(kC3[4]) * z * (x * x - y * y);
    b[15][i] = -T(kC3[0]) * x * (x * x - 3 * y * y);
  }
}

// Gradient towards the means: g[k][i] is that towards basis function k of surfel first + i.
template <class T>
void basis_backward(const ColorJob<T>& job, int64_t first, int count, const Directions<T>& d,
                    const T (*g)[kColorBlock]) {
  T out[3][kColorBlock];
  for (int i = 0; i < count; ++i) {
    out[0][i] = -T(kC1) * g[3][i];
    out[1][i] = -T(kC1) * g[1][i];
    out[2][i] = T(kC1) * g[2][i];
  }
  if (job.degree >= 2) {
    for (int i = 0; i < count; ++i) {
      const T x = d.x[i], y = d.y[i], z = d.z[i];
      out[0][i] += T(kC2[0]) * (y * g[4][i] - z * g[7][i]) + T(2 * kC2[2]) * x * g[8][i];
      out[1][i] += T(kC2[0]) * (x * g[4][i] - z * g[5][i]) - T(2 * kC2[2]) * y * g[8][i];
      out[2][i] += -T(kC2[0]) * (y * g[5][i] + x * g[7][i]) + T(6 * kC2[1]) * z * g[6][i];
    }
  }
  if (job.degree >= 3) {
    for (int i = 0; i < count; ++i) {
      const T x = d.x[i], y = d.y[i], z = d.z[i];
      const T xx = x * x, yy = y * y, zz = z * z;
      out[0][i] += -T(6 * kC3[0]) * x * y * g[9][i] + T(kC3[1]) * y * z * g[10][i] -
                   T(kC3[2]) * (5 * zz - 1) * g[13][i] + T(2 * kC3[4]) * x * z * g[14][i] -
                   T(3 * kC3[0]) * (xx - yy) * g[15][i];
      out[1][i] += -T(3 * kC3[0]) * (xx - yy) * g[9][i] + T(kC3[1]) * x * z * g[10][i] -
                   T(kC3[2]) * (5 * zz - 1) * g[11][i] - T(2 * kC3[4]) * y * z * g[14][i] +
                   T(6 * kC3[0]) * x * y * g[15][i];
      out[2][i] += T(kC3[1]) * x * y * g[10][i] - T(10 * kC3[2]) * z * (y * g[11][i] + x * g[13][i]) +
                   T(kC3[3]) * (15 * zz - 3) * g[12][i] + T(kC3[4]) * (xx - yy) * g[14][i];
    }
  }
  for (int i = 0; i < count; ++i) {  // d = p / |p|; at the camera |p| is held at its least
    T along = out[0][i] * d.x[i] + out[1][i] * d.y[i] + out[2][i] * d.z[i];
    if (d.inverse[i] >= T(1 / kLeastDistance)) along = 0;
    job.g_means[3 * (first + i)] = (out[0][i] - along * d.x[i]) * d.inverse[i];
    job.g_means[3 * (first + i) + 1] = (out[1][i] - along * d.y[i]) * d.inverse[i];
    job.g_means[3 * (first + i) + 2] = (out[2][i] - along * d.z[i]) * d.inverse[i];
  }
}

template <class T, int kDegree>
void colors_of_degree(const ColorJob<T>& job, int64_t first, int64_t last) {
  constexpr int kBases = (kDegree + 1) * (kDegree + 1);
  const int count = static_cast<int>(last - first);
  T b[kBases][kColorBlock];
  Directions<T> d;
  if (kDegree > 0) directions(job, first, count, d);
  basis(kDegree, count, d, b);
  for (int i = 0; i < count; ++i) {
    const T *dc = job.dc + 3 * (first + i), *rest = job.rest + (first + i) * job.num_rest * 3;
    T sum[3];
    for (int c = 0; c < 3; ++c) sum[c] = b[0][i] * dc[c];
    for (int k = 1; k < kBases; ++k) {
      for (int c = 0; c < 3; ++c) sum[c] += b[k][i] * rest[3 * (k - 1) + c];
    }
    uint8_t clamped = 0;
    for (int c = 0; c < 3; ++c) {
      const T value = sum[c] + T(0.5);
      clamped |= static_cast<uint8_t>((value < 0) << c);
      job.colors[3 * (first + i) + c] = value < 0 ? T(0) : value;  // NaN stays
    }
    job.clamped[first + i] = clamped;
  }
}

template <class T, int kDegree>
void colors_backward_of_degree(const ColorJob<T>& job, int64_t first, int64_t last) {
  constexpr int kBases = (kDegree + 1) * (kDegree + 1);
  const int count = static_cast<int>(last - first);
  T b[kBases][kColorBlock], g_basis[kBases][kColorBlock];
  Directions<T> d;
  if (kDegree > 0) directions(job, first, count, d);
  basis(kDegree, count, d, b);
  for (int i = 0; i < count; ++i) {
    const int64_t row = first + i;
    T g[3];
    for (int c = 0; c < 3; ++c) g[c] = job.clamped[row] >> c & 1 ? T(0) : job.g_colors[3 * row + c];
    if (job.g_dc) {
      for (int c = 0; c < 3; ++c) job.g_dc[3 * row + c] = b[0][i] * g[c];
    }
    if (job.g_rest) {
      T* to = job.g_rest + row * job.num_rest * 3;
      for (int k = 1; k < kBases; ++k) {
        for (int c = 0; c < 3; ++c) to[3 * (k - 1) + c] = b[k][i] * g[c];
      }
      for (int k = 3 * (kBases - 1); k < 3 * job.num_rest; ++k) to[k] = 0;
    }
    if (kDegree > 0 && job.g_means) {
      const T* rest = job.rest + row * job.num_rest * 3;
      for (int k = 1; k < kBases; ++k) {  // the first function is constant
        const T* sh = rest + 3 * (k - 1);
        g_basis[k][i] = g[0] * sh[0] + g[1] * sh[1] + g[2] * sh[2];
      }
    }
  }
  if constexpr (kDegree > 0) {
    if (job.g_means) basis_backward(job, first, count, d, g_basis);
  }
}

template <class T>
void colors(const ColorJob<T>& job, int64_t first, int64_t last) {
  if (job.degree == 0) colors_of_degree<T, 0>(job, first, last);
  if (job.degree == 1) colors_of_degree<T, 1>(job, first, last);
  if (job.degree == 2) colors_of_degree<T, 2>(job, first, last);
  if (job.degree == 3) colors_of_degree<T, 3>(job, first, last);
}

template <class T>
void colors_backward(const ColorJob<T>& job, int64_t first, int64_t last) {
  if (job.degree == 0) colors_backward_of_degree<T, 0>(job, first, last);
  if (job.degree == 1) colors_backward_of_degree<T, 1>(job, first, last);
  if (job.degree == 2) colors_backward_of_degree<T, 2>(job, first, last);
  if (job.degree == 3) colors_backward_of_degree<T, 3>(job, first, last);
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
