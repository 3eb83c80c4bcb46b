// Defines the multiplier of the hashes and random streams.
#pragma once

#include <stdint.h>

namespace beags {
namespace ops {

constexpr uint64_t kGolden = 0x9E3779B97F4A7C15u;  // 2^64 / golden ratio

}  // namespace ops
}  // namespace beags
