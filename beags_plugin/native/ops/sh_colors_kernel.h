// Computes colours from spherical harmonics of degree 0 to 3 (method, section 1), a block of Gaussians at a time: first
// the basis of all of them, then their sums. Included once for each instruction set.
#pragma once

#include "ops/sh_colors_terms.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

template <class T>
struct Directions {
  T x[kColorBlock], y[kColorBlock], z[kColorBlock], inverse[kColorBlock];

  BEAGS_INLINE Direction<T> operator[](int i) const { return {x[i], y[i], z[i], inverse[i]}; }
};

template <class T>
void directions(const ColorJob<T>& job, int64_t first, int count, Directions<T>& d) {
  for (int i = 0; i < count; ++i) {
    const Direction<T> one = direction(job, first + i);
    d.x[i] = one.x;
    d.y[i] = one.y;
    d.z[i] = one.z;
    d.inverse[i] = one.inverse;
  }
}

template <int kDegree, class T>
void basis_of_block(int count, const Directions<T>& d, T (*b)[kColorBlock]) {
  for (int i = 0; i < count; ++i) basis<kDegree>(d[i], [&](int k, T value) { b[k][i] = value; });
}

// Goes degree by degree: compilers vectorise loops as short as these.
template <int kDegree, class T>
void add_backward(int count, const Directions<T>& d, const T (*g)[kColorBlock], T (*out)[kColorBlock]) {
  for (int i = 0; i < count; ++i) {
    const DirectionGradient<T> more = basis_backward<kDegree>(d[i], [&](int k) { return g[k][i]; });
    out[0][i] += more.x;
    out[1][i] += more.y;
    out[2][i] += more.z;
  }
}

template <class T, int kDegree>
void colors_of_degree(const ColorJob<T>& job, int64_t first, int64_t last) {
  constexpr int kBases = (kDegree + 1) * (kDegree + 1);
  const int count = static_cast<int>(last - first);
  T b[kBases][kColorBlock];
  Directions<T> d;
  if (kDegree > 0) directions(job, first, count, d);
  basis_of_block<kDegree>(count, d, b);
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
      job.colors[3 * (first + i) + c] = value < 0 ? T(0) : value;  // NaN remains NaN.
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
  basis_of_block<kDegree>(count, d, b);
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
      for (int k = 1; k < kBases; ++k) {  // The first function is constant.
        const T* sh = rest + 3 * (k - 1);
        g_basis[k][i] = g[0] * sh[0] + g[1] * sh[1] + g[2] * sh[2];
      }
    }
  }
  if constexpr (kDegree > 0) {
    if (job.g_means) {
      T out[3][kColorBlock] = {};
      add_backward<1>(count, d, g_basis, out);
      if constexpr (kDegree >= 2) add_backward<2>(count, d, g_basis, out);
      if constexpr (kDegree >= 3) add_backward<3>(count, d, g_basis, out);
      for (int i = 0; i < count; ++i) {
        to_mean(d[i], DirectionGradient<T>{out[0][i], out[1][i], out[2][i]}, job.g_means + 3 * (first + i));
      }
    }
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
