// Colours from spherical harmonics, a thread a surfel (method, section 1); normalisation, signs and order as
// core/sh.py.
#include "ops.h"

namespace beags {
namespace cuda {
namespace {

using ops::ColorJob;

constexpr double kC0 = 0.28209479177387814, kC1 = 0.4886025119029199;
constexpr double kC20 = 1.0925484305920792, kC21 = 0.31539156525252005, kC22 = 0.5462742152960396;
constexpr double kC30 = 0.5900435899266435, kC31 = 2.890611442640554, kC32 = 0.4570457994644658,
                 kC33 = 0.3731763325901154, kC34 = 1.445305721320277;
constexpr double kLeastDistance = 1e-12;  // a surfel at the camera

template <class T>
struct Direction {
  T x, y, z, inverse;  // unit vector, and 1 / distance

  BEAGS_DEVICE Direction(const ColorJob<T>& job, int64_t i) {
    x = job.means[3 * i] - job.center[0];
    y = job.means[3 * i + 1] - job.center[1];
    z = job.means[3 * i + 2] - job.center[2];
    const T length = sqrt(x * x + y * y + z * z), least_length = static_cast<T>(kLeastDistance);
    inverse = T(1) / (length < least_length ? least_length : length);
    x *= inverse;
    y *= inverse;
    z *= inverse;
  }
};

template <int kDegree, class T>
BEAGS_DEVICE void basis(const Direction<T>& d, T* b) {
  const T x = d.x, y = d.y, z = d.z;
  b[0] = T(kC0);
  if (kDegree >= 1) {
    b[1] = -T(kC1) * y;
    b[2] = T(kC1) * z;
    b[3] = -T(kC1) * x;
  }
  if (kDegree >= 2) {
    b[4] = T(kC20) * x * y;
    b[5] = -T(kC20) * y * z;
    b[6] = T(kC21) * (3 * z * z - 1);
    b[7] = -T(kC20) * x * z;
    b[8] = T(kC22) * (x * x - y * y);
  }
  if (kDegree >= 3) {
    b[9] = -T(kC30) * y * (3 * x * x - y * y);
    b[10] = T(kC31) * x * y * z;
    b[11] = -T(kC32) * y * (5 * z * z - 1);
    b[12] = T(kC33) * z * (5 * z * z - 3);
    b[13] = -T(kC32) * x * (5 * z * z - 1);
    b[14] = T(kC34) * z * (x * x - y * y);
    b[15] = -T(kC30) * x * (x * x - 3 * y * y);
  }
}

// The gradient towards a mean from that towards the basis.
template <int kDegree, class T>
BEAGS_DEVICE void basis_backward(const Direction<T>& d, const T* g, T* to) {
  const T x = d.x, y = d.y, z = d.z;
  T out[3] = {-T(kC1) * g[3], -T(kC1) * g[1], T(kC1) * g[2]};
  if (kDegree >= 2) {
    out[0] += T(kC20) * (y * g[4] - z * g[7]) + T(2 * kC22) * x * g[8];
    out[1] += T(kC20) * (x * g[4] - z * g[5]) - T(2 * kC22) * y * g[8];
    out[2] += -T(kC20) * (y * g[5] + x * g[7]) + T(6 * kC21) * z * g[6];
  }
  if (kDegree >= 3) {
    const T xx = x * x, yy = y * y, zz = z * z;
    out[0] += -T(6 * kC30) * x * y * g[9] + T(kC31) * y * z * g[10] - T(kC32) * (5 * zz - 1) * g[13] +
              T(2 * kC34) * x * z * g[14] - T(3 * kC30) * (xx - yy) * g[15];
    out[1] += -T(3 * kC30) * (xx - yy) * g[9] + T(kC31) * x * z * g[10] - T(kC32) * (5 * zz - 1) * g[11] -
              T(2 * kC34) * y * z * g[14] + T(6 * kC30) * x * y * g[15];
    out[2] += T(kC31) * x * y * g[10] - T(10 * kC32) * z * (y * g[11] + x * g[13]) + T(kC33) * (15 * zz - 3) * g[12] +
              T(kC34) * (xx - yy) * g[14];
  }
  // d = p / |p|; at the camera |p| is held at its least
  T along = out[0] * x + out[1] * y + out[2] * z;
  if (d.inverse >= T(1 / kLeastDistance)) along = 0;
  to[0] = (out[0] - along * x) * d.inverse;
  to[1] = (out[1] - along * y) * d.inverse;
  to[2] = (out[2] - along * z) * d.inverse;
}

template <int kDegree, class T>
__global__ void colors_kernel(ColorJob<T> job, int64_t count) {
  constexpr int kBases = (kDegree + 1) * (kDegree + 1);
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= count) return;
  T b[kBases];
  basis<kDegree>(Direction<T>(job, i), b);
  const T *dc = job.dc + 3 * i, *rest = job.rest + i * job.num_rest * 3;
  uint8_t clamped = 0;
  for (int c = 0; c < 3; ++c) {
    T value = b[0] * dc[c];
    for (int k = 1; k < kBases; ++k) value += b[k] * rest[3 * (k - 1) + c];
    value += T(0.5);
    clamped |= static_cast<uint8_t>((value < 0) << c);
    job.colors[3 * i + c] = value < 0 ? T(0) : value;  // NaN stays
  }
  job.clamped[i] = clamped;
}

template <int kDegree, class T>
__global__ void colors_backward_kernel(ColorJob<T> job, int64_t count) {
  constexpr int kBases = (kDegree + 1) * (kDegree + 1);
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= count) return;
  const Direction<T> direction(job, i);
  T b[kBases], g[3];
  basis<kDegree>(direction, b);
  for (int c = 0; c < 3; ++c) g[c] = job.clamped[i] >> c & 1 ? T(0) : job.g_colors[3 * i + c];
  if (job.g_dc) {
    for (int c = 0; c < 3; ++c) job.g_dc[3 * i + c] = b[0] * g[c];
  }
  if (job.g_rest) {
    T* to = job.g_rest + i * job.num_rest * 3;
    for (int k = 1; k < kBases; ++k) {
      for (int c = 0; c < 3; ++c) to[3 * (k - 1) + c] = b[k] * g[c];
    }
    for (int k = 3 * (kBases - 1); k < 3 * job.num_rest; ++k) to[k] = 0;
  }
  if (kDegree > 0 && job.g_means) {
    const T* rest = job.rest + i * job.num_rest * 3;
    T g_basis[16] = {};
    for (int k = 1; k < kBases; ++k) {  // the first function is constant
      const T* sh = rest + 3 * (k - 1);
      g_basis[k] = g[0] * sh[0] + g[1] * sh[1] + g[2] * sh[2];
    }
    basis_backward<kDegree>(direction, g_basis, job.g_means + 3 * i);
  }
}

}  // namespace

template <class T>
void sh_colors(const ColorJob<T>& job, int64_t count, Stream stream) {
  auto kernel = colors_kernel<0, T>;
  if (job.degree == 1) kernel = colors_kernel<1, T>;
  if (job.degree == 2) kernel = colors_kernel<2, T>;
  if (job.degree == 3) kernel = colors_kernel<3, T>;
  BEAGS_LAUNCH(kernel, blocks_for(count, 128), 128, stream, job, count);
}

template <class T>
void sh_colors_backward(const ColorJob<T>& job, int64_t count, Stream stream) {
  auto kernel = colors_backward_kernel<0, T>;
  if (job.degree == 1) kernel = colors_backward_kernel<1, T>;
  if (job.degree == 2) kernel = colors_backward_kernel<2, T>;
  if (job.degree == 3) kernel = colors_backward_kernel<3, T>;
  BEAGS_LAUNCH(kernel, blocks_for(count, 128), 128, stream, job, count);
}

#define BEAGS_INSTANTIATE(T)                                    \
  template void sh_colors(const ColorJob<T>&, int64_t, Stream); \
  template void sh_colors_backward(const ColorJob<T>&, int64_t, Stream);
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace cuda
}  // namespace beags
