// Reports to GCC's thread sanitizer how the emulated threads of a kernel are ordered. The sanitizer then finds what
// compute-sanitizer's racecheck looks for, and races in global memory besides. Each thread is a fiber of the
// sanitizer, and only launches and barriers order fibers; operations of a warp and atomic ones do not. Without the
// sanitizer, all of this is empty.
//
// All blocks share one shared memory here, so they must be ordered to not race for it, which hides races between
// blocks. BEAGS_EMULATION_UNORDERED=1 in the environment leaves a block and the two before it unordered; reports about
// shared memory must then be ignored.
#pragma once

#if defined(__SANITIZE_THREAD__)

#include <cstdlib>

extern "C" {
void* __tsan_get_current_fiber(void);
void* __tsan_create_fiber(unsigned flags);
void __tsan_switch_to_fiber(void* fiber, unsigned flags);
void __tsan_acquire(void* at);
void __tsan_release(void* at);
}

#define BEAGS_UNSEEN __attribute__((no_sanitize("thread"), noinline))

namespace beags {
namespace emulation {

constexpr unsigned kUnordered = 1;  // flag: a switch to a fiber orders nothing
constexpr unsigned kSets = 3;  // sets of fibers and stacks, which blocks use in turn, because making one takes long

struct Places {  // Only their addresses matter.
  char launched, ended[2], barrier[2];
};
inline Places places;
inline bool ordered() {
  static const bool so = std::getenv("BEAGS_EMULATION_UNORDERED") == nullptr;
  return so;
}

// The places of one thread of a block.
struct Races {
  void* fibers[kSets] = {};
  unsigned set = 0, barriers = 0;

  BEAGS_UNSEEN unsigned make(unsigned block) {
    set = ordered() ? 0 : block % kSets;
    if (!fibers[set]) fibers[set] = __tsan_create_fiber(kUnordered);
    barriers = 0;
    return set;
  }
  BEAGS_UNSEEN void enter() { __tsan_switch_to_fiber(fibers[set], kUnordered); }
  // Two places in turn: threads may reach the next barrier before others have left this one.
  BEAGS_UNSEEN void arrive() { __tsan_release(&places.barrier[barriers & 1]); }
  BEAGS_UNSEEN void pass() { __tsan_acquire(&places.barrier[barriers++ & 1]); }
};

// The places of all blocks of a launch.
struct Grid {
  void* host = nullptr;

  BEAGS_UNSEEN void launch() {
    host = __tsan_get_current_fiber();
    __tsan_release(&places.launched);
  }
  BEAGS_UNSEEN void finish() {
    for (char& ended : places.ended) __tsan_acquire(&ended);
  }
  BEAGS_UNSEEN void leave() { __tsan_switch_to_fiber(host, kUnordered); }
  // The places of each thread of a block, two in turn, because a block's first threads end before its last ones begin.
  BEAGS_UNSEEN void begin(unsigned block) {
    __tsan_acquire(&places.launched);
    if (ordered()) __tsan_acquire(&places.ended[(block + 1) & 1]);
  }
  BEAGS_UNSEEN void end(unsigned block) { __tsan_release(&places.ended[block & 1]); }
};

}  // namespace emulation
}  // namespace beags

#else

#define BEAGS_UNSEEN

namespace beags {
namespace emulation {

constexpr unsigned kSets = 1;

struct Races {
  unsigned make(unsigned) { return 0; }
  void enter() {}
  void arrive() {}
  void pass() {}
};

struct Grid {
  void launch() {}
  void finish() {}
  void leave() {}
  void begin(unsigned) {}
  void end(unsigned) {}
};

}  // namespace emulation
}  // namespace beags

#endif
