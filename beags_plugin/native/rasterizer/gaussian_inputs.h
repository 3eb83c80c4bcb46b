// Turns a Gaussian's parameters into its splat, on the CPU and on GPUs.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "rasterizer/projection.h"

namespace beags {

// N Gaussians, contiguous, as SurfelInputs of rasterizers/interface.py; class_ids may be null.
template <class T>
struct Inputs {
  int64_t count;
  const T *means, *quats, *log_scales, *opacity_logits, *colors;
  const int32_t* class_ids;
};

template <class T>
BEAGS_HD bool all_finite(const T* numbers, int count) {
  T zero = 0;
  for (int i = 0; i < count; ++i) zero += 0 * numbers[i];
  return zero == 0;
}

// Reads Gaussian i; its transcendental functions are computed in T.
template <class T>
BEAGS_HD GaussianParameters parameters(const Inputs<T>& inputs, int64_t i) {
  GaussianParameters s;
  for (int axis = 0; axis < 3; ++axis) s.mean[axis] = inputs.means[3 * i + axis];
  for (int axis = 0; axis < 4; ++axis) s.quat[axis] = inputs.quats[4 * i + axis];
  for (int axis = 0; axis < 2; ++axis) s.scale[axis] = std::exp(inputs.log_scales[2 * i + axis]);
  const T logit = inputs.opacity_logits[i], faded = std::exp(-std::abs(logit));
  s.log2_opacity = std::min(logit, T(0)) / kLn2 - std::log2(1 + faded);
  s.transparency = (logit > 0 ? faded : T(1)) / (1 + faded);
  return s;
}

// Rounds all but colour and class to T; returns false if that overflows.
template <class T>
BEAGS_HD bool narrow(const Splat<double>& from, Splat<T>& to) {
  T zero = 0;
  const auto round = [&](double number) {
    const T rounded = static_cast<T>(number);
    zero += 0 * rounded;  // It becomes NaN if a number is not finite.
    return rounded;
  };
  to.cx = round(from.cx);
  to.cy = round(from.cy);
  to.u_x = round(from.u_x);
  to.u_y = round(from.u_y);
  to.v_x = round(from.v_x);
  to.v_y = round(from.v_y);
  to.w_x = round(from.w_x);
  to.w_y = round(from.w_y);
  to.w_0 = round(from.w_0);
  to.det = round(from.det);
  to.z = round(from.z);
  to.nearness_z = round(from.nearness_z);
  to.log2_opacity = round(from.log2_opacity);
  to.tilt_u = round(from.tilt_u);
  to.tilt_v = round(from.tilt_v);
  // For an edge-on Gaussian, det = 0: no hit reads this number, but it must not be NaN.
  constexpr double kLargest = std::numeric_limits<T>::max();
  to.nearness_det = static_cast<T>(std::clamp(from.nearness_det, -kLargest, kLargest));
  for (int i = 0; i < 3; ++i) to.normal[i] = static_cast<T>(from.normal[i]);
  to.plain = from.plain;
  return zero == 0;
}

// Projects Gaussian i.
template <class T>
BEAGS_HD Fate place_gaussian(const View& view, const Inputs<T>& inputs, int64_t i, Splat<T>& splat) {
  if (!all_finite(inputs.means + 3 * i, 3) || !all_finite(inputs.quats + 4 * i, 4) ||
      !all_finite(inputs.log_scales + 2 * i, 2) || !all_finite(inputs.opacity_logits + i, 1) ||
      !all_finite(inputs.colors + 3 * i, 3)) {
    return Fate::kNonFinite;
  }
  Splat<double> exact;
  const Fate fate = project(view, parameters(inputs, i), exact);
  if (fate != Fate::kRendered) return fate;
  for (int c = 0; c < 3; ++c) splat.color[c] = inputs.colors[3 * i + c];
  splat.class_id = inputs.class_ids ? inputs.class_ids[i] : 0;
  return narrow(exact, splat) ? Fate::kRendered : Fate::kNonFinite;
}

}  // namespace beags
