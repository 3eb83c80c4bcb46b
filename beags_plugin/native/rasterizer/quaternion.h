// Defines which quaternions are usable, by the rule of core/rotations.py.
#pragma once

#include "simd/device.h"

namespace beags {

// Quaternions that are longer, or shorter than 1 / kLongestQuat, count as broken: their gradient, which is that of the
// rotation divided by the length, would overflow in float32.
constexpr double kLongestQuat = 1e12;

template <class T>
BEAGS_HD_INLINE bool usable_quaternion(T inverse_length) {
  return inverse_length <= static_cast<T>(kLongestQuat) && inverse_length >= static_cast<T>(1 / kLongestQuat);
}

}  // namespace beags
