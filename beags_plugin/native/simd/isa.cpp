#include "simd/isa.h"

#include <cstdlib>
#include <stdexcept>
#include <type_traits>

namespace beags {

#define BEAGS_DECLARE(name)                 \
  namespace name {                          \
  extern const Kernels<float> kKernelsF32;  \
  extern const Kernels<double> kKernelsF64; \
  }
BEAGS_DECLARE(scalar)
BEAGS_DECLARE(baseline)
BEAGS_DECLARE(neon)
BEAGS_DECLARE(avx2)
BEAGS_DECLARE(avx512)
#undef BEAGS_DECLARE

namespace {

struct InstructionSet {
  const char* name;
  bool runs;
  const Kernels<float>* f32;
  const Kernels<double>* f64;
};
#define BEAGS_SET(name, runs) {#name, runs, &name::kKernelsF32, &name::kKernelsF64}

// Returns the sets of this build, best first. The scalar kernels are the base of comparisons, never the best.
std::vector<InstructionSet> built() {
  return {
#if defined(BEAGS_HAS_AVX512)
      BEAGS_SET(avx512, __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
                            __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
                            __builtin_cpu_supports("fma")),
#endif
#if defined(BEAGS_HAS_AVX2)
      BEAGS_SET(avx2, __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")),
#endif
#if defined(BEAGS_HAS_NEON)
      BEAGS_SET(neon, true),
#endif
#if defined(BEAGS_HAS_BASELINE)
      BEAGS_SET(baseline, true),
#endif
      BEAGS_SET(scalar, true),
  };
}
#undef BEAGS_SET

std::string joined(const std::vector<std::string>& names) {
  std::string text;
  for (const std::string& name : names) text += (text.empty() ? "" : ", ") + name;
  return text;
}

InstructionSet choose() {
  const std::vector<InstructionSet> sets = built();
  const char* forced = std::getenv("BEAGS_ISA");
  bool known = false;
  for (const InstructionSet& set : sets) {
    const bool meant = forced && *forced && set.name == std::string(forced);
    known = known || meant;
    if (set.runs && (meant || !forced || !*forced)) return set;
  }
  const std::string why = known ? "this processor lacks" : "this build does not hold";
  throw std::runtime_error("BEAGS_ISA asks for the instruction set '" + std::string(forced) + "', which " + why +
                           "; take one of " + joined(instruction_sets()) + ", or unset it.");
}

const InstructionSet& chosen() {
  static const InstructionSet set = choose();  // If it throws, the next call tries again.
  return set;
}

}  // namespace

std::vector<std::string> instruction_sets() {
  std::vector<std::string> names;
  for (const InstructionSet& set : built()) {
    if (set.runs) names.push_back(set.name);
  }
  return names;
}

const std::string& instruction_set() {
  static const std::string name = chosen().name;
  return name;
}

bool uses_avx2() {
  static const bool uses = instruction_set() == "avx2" || instruction_set() == "avx512";
  return uses;
}

template <>
const Kernels<float>& kernels() {
  return *chosen().f32;
}
template <>
const Kernels<double>& kernels() {
  return *chosen().f64;
}

}  // namespace beags
