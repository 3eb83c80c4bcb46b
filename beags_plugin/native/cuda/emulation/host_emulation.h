// Runs CUDA kernels on one CPU thread, to test their logic without a GPU: the C++ compiler compiles the same sources.
// The threads of a block are fibers, which run in turn until they meet at a barrier or in an operation of their warp.
// This finds wrong indices, wrong sums and barriers that not all threads reach, and data races in a build for GCC's
// thread sanitizer (emulated_races.h). It shows neither a GPU's rounding nor its speed.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <memory>
#include <vector>
#if !defined(__x86_64__)
#include <ucontext.h>
#endif

#include "cuda/emulation/emulated_races.h"

#define __global__
#define __device__
#define __shared__ static
#define __launch_bounds__(...)
#define BEAGS_DEVICE inline
#define threadIdx (::beags::emulation::thread_index())
#define blockIdx (::beags::emulation::block_index())
#define blockDim (::beags::emulation::block_size())

struct uint4 {
  uint32_t x, y, z, w;
};

#if defined(__x86_64__)
// Saves the registers that a call must preserve on this stack, then continues on another stack.
extern "C" void beags_switch_stack(void** from, void* to);
asm(R"(
.text
.type beags_switch_stack,@function
beags_switch_stack:
  pushq %rbp
  pushq %rbx
  pushq %r12
  pushq %r13
  pushq %r14
  pushq %r15
  movq %rsp, (%rdi)
  movq %rsi, %rsp
  popq %r15
  popq %r14
  popq %r13
  popq %r12
  popq %rbx
  popq %rbp
  ret
.size beags_switch_stack,.-beags_switch_stack
)");
#endif

namespace beags {
namespace emulation {

constexpr int kWarp = 32;
constexpr int kMostThreads = 1024;
constexpr size_t kStack = 64 << 10;

struct Index {
  unsigned x;
};

enum class State { kReady, kInWarp, kAtBarrier, kDone };

struct Fiber {
  State state;
  int operations;       // operations of its warp so far
  const char* barrier;  // the barrier that it waits at
  Races races;
#if defined(__x86_64__)
  void* stack_pointer;
#else
  ucontext_t context;
#endif
};

struct Warp {
  int arrived;
  const char* operation;
  alignas(16) unsigned char values[2][kWarp][16];  // values of this operation and of the one before
};

// The block that runs; there is one at a time.
struct Block {
  Fiber fibers[kMostThreads];
  Warp warps[kMostThreads / kWarp];
  std::unique_ptr<unsigned char[]> stacks{new unsigned char[kMostThreads * kSets * kStack]};
  const std::function<void()>* body = nullptr;
  unsigned block = 0, threads = 0, current = 0;
  int voted = 0, votes = 0;  // threads that voted yes at a barrier so far; the result
  Grid grid;
#if defined(__x86_64__)
  void* scheduler = nullptr;
#else
  ucontext_t scheduler;
#endif
};

BEAGS_UNSEEN inline Block& block() {
  static Block one;
  return one;
}
BEAGS_UNSEEN inline Index thread_index() { return {block().current}; }
BEAGS_UNSEEN inline Index block_index() { return {block().block}; }
BEAGS_UNSEEN inline Index block_size() { return {block().threads}; }

[[noreturn]] inline void fail(const char* what) {
  std::fprintf(stderr, "CUDA emulation: %s\n", what);
  std::abort();
}

BEAGS_UNSEEN inline void wait(State state) {
  Block& b = block();
  Fiber& fiber = b.fibers[b.current];
  fiber.state = state;
  b.grid.leave();
#if defined(__x86_64__)
  beags_switch_stack(&fiber.stack_pointer, b.scheduler);
#else
  swapcontext(&fiber.context, &b.scheduler);
#endif
}

BEAGS_UNSEEN inline void run_fiber() {
  Block& b = block();
  b.grid.begin(b.block);
  (*b.body)();
  b.grid.end(b.block);
  wait(State::kDone);
  fail("a thread that had ended went on");
}

BEAGS_UNSEEN inline void start(unsigned thread) {
  Block& b = block();
  Fiber& fiber = b.fibers[thread];
  fiber.state = State::kReady;
  fiber.operations = 0;
  const unsigned set = fiber.races.make(b.block);
  unsigned char* stack = b.stacks.get() + (set * kMostThreads + thread) * kStack;
#if defined(__x86_64__)
  void** top = reinterpret_cast<void**>(reinterpret_cast<uintptr_t>(stack + kStack) & ~uintptr_t(15));
  *--top = nullptr;  // This null takes the place of a return address.
  *--top = reinterpret_cast<void*>(&run_fiber);
  for (int i = 0; i < 6; ++i) *--top = nullptr;
  fiber.stack_pointer = top;
#else
  getcontext(&fiber.context);
  fiber.context.uc_stack.ss_sp = stack;
  fiber.context.uc_stack.ss_size = kStack;
  fiber.context.uc_link = nullptr;
  makecontext(&fiber.context, run_fiber, 0);
#endif
}

BEAGS_UNSEEN inline void resume(unsigned thread) {
  Block& b = block();
  b.current = thread;
  b.fibers[thread].races.enter();
#if defined(__x86_64__)
  beags_switch_stack(&b.scheduler, b.fibers[thread].stack_pointer);
#else
  swapcontext(&b.scheduler, &b.fibers[thread].context);
#endif
}

BEAGS_UNSEEN inline void run_block(unsigned index, unsigned threads, const std::function<void()>& body) {
  Block& b = block();
  b.block = index;
  b.threads = threads;
  b.body = &body;
  b.voted = 0;
  for (unsigned thread = 0; thread < threads; ++thread) start(thread);
  for (unsigned warp = 0; warp * kWarp < threads; ++warp) b.warps[warp].arrived = 0;
  for (bool alive = true; alive;) {
    for (unsigned first = 0; first < threads; first += kWarp) {  // A warp runs as far as it can.
      for (bool moved = true; moved;) {
        moved = false;
        for (unsigned thread = first; thread < first + kWarp && thread < threads; ++thread) {
          if (b.fibers[thread].state != State::kReady) continue;
          resume(thread);
          moved = true;
        }
      }
    }
    alive = false;
    b.votes = b.voted;
    b.voted = 0;
    const char* barrier = nullptr;
    unsigned ended = 0;
    for (unsigned thread = 0; thread < threads; ++thread) {
      Fiber& fiber = b.fibers[thread];
      if (fiber.state == State::kInWarp) fail("some threads of a warp never reach its operation");
      ended += fiber.state == State::kDone;
      if (fiber.state != State::kAtBarrier) continue;
      if (barrier && std::strcmp(barrier, fiber.barrier) != 0) fail("threads of a block are at different barriers");
      barrier = fiber.barrier;
      fiber.state = State::kReady;
      alive = true;
    }
    if (alive && ended) fail("some threads of a block never reach a barrier");
  }
}

BEAGS_UNSEEN inline void launch(int64_t blocks, unsigned threads, const std::function<void()>& body) {
  if (threads > kMostThreads || threads % kWarp) fail("a block must have whole warps, and 1024 threads at most");
  block().grid.launch();
  for (int64_t index = 0; index < blocks; ++index) run_block(static_cast<unsigned>(index), threads, body);
  block().grid.finish();
}

// Waits for the other threads of the warp; returns the value of each.
template <class V>
BEAGS_UNSEEN const V (*exchange(const char* operation, V value))[1] {
  static_assert(sizeof(V) <= 16, "fits a slot");
  Block& b = block();
  Fiber& fiber = b.fibers[b.current];
  Warp& warp = b.warps[b.current / kWarp];
  unsigned char (*values)[16] = warp.values[fiber.operations++ & 1];
  std::memcpy(values[b.current % kWarp], &value, sizeof value);
  if (warp.arrived && std::strcmp(warp.operation, operation) != 0)
    fail("threads of a warp are in different operations");
  warp.operation = operation;
  if (++warp.arrived == kWarp) {
    warp.arrived = 0;
    const unsigned first = b.current / kWarp * kWarp;
    for (unsigned thread = first; thread < first + kWarp; ++thread) b.fibers[thread].state = State::kReady;
  } else {
    wait(State::kInWarp);
  }
  return reinterpret_cast<const V(*)[1]>(values);
}

// Returns one lane's value from the result of `exchange`.
template <class V>
BEAGS_UNSEEN V lane_value(const V (*values)[1], int lane) {
  V value;
  std::memcpy(&value, reinterpret_cast<const unsigned char*>(values) + 16 * lane, sizeof value);
  return value;
}

}  // namespace emulation
}  // namespace beags

namespace beags {
namespace emulation {

BEAGS_UNSEEN inline void meet(const char* barrier) {
  Fiber& fiber = block().fibers[block().current];
  fiber.barrier = barrier;
  fiber.races.arrive();
  wait(State::kAtBarrier);
  fiber.races.pass();
}
BEAGS_UNSEEN inline int meet_and_count(const char* barrier, int yes) {
  block().voted += yes != 0;
  meet(barrier);
  return block().votes;
}

}  // namespace emulation
}  // namespace beags

#define BEAGS_PLACE_OF(line) __FILE__ ":" #line
#define BEAGS_PLACE(line) BEAGS_PLACE_OF(line)
#define __syncthreads() ::beags::emulation::meet(BEAGS_PLACE(__LINE__))
#define __syncthreads_count(yes) ::beags::emulation::meet_and_count(BEAGS_PLACE(__LINE__), (yes))

inline unsigned __ballot_sync(unsigned, int yes) {
  const auto values = beags::emulation::exchange("ballot", yes != 0 ? 1u : 0u);
  unsigned bits = 0;
  for (int lane = 0; lane < 32; ++lane) bits |= beags::emulation::lane_value(values, lane) << lane;
  return bits;
}
inline int __any_sync(unsigned mask, int yes) { return __ballot_sync(mask, yes) != 0; }
template <class V>
V __shfl_xor_sync(unsigned, V value, int mask) {
  const auto values = beags::emulation::exchange("shuffle", value);
  return beags::emulation::lane_value(values, static_cast<int>(threadIdx.x % 32) ^ mask);
}
template <class V>
V __shfl_sync(unsigned, V value, int lane) {
  return beags::emulation::lane_value(beags::emulation::exchange("shuffle", value), lane);
}

template <class V, class W>
V atomicAdd(V* at, W value) {
  return __atomic_fetch_add(at, static_cast<V>(value), __ATOMIC_RELAXED);
}
template <class V>
V atomicOr(V* at, V value) {
  return __atomic_fetch_or(at, value, __ATOMIC_RELAXED);
}
template <class V>
V atomicCAS(V* at, V expected, V value) {
  __atomic_compare_exchange_n(at, &expected, value, false, __ATOMIC_RELAXED, __ATOMIC_RELAXED);
  return expected;
}
template <class V>
V atomicExch(V* at, V value) {
  return __atomic_exchange_n(at, value, __ATOMIC_RELAXED);
}
template <class V>
V atomicMax(V* at, V value) {
  V before = __atomic_load_n(at, __ATOMIC_RELAXED);
  // Writes the value even if it is equal, as a GPU may, so that the thread sanitizer sees a write.
  while (!__atomic_compare_exchange_n(at, &before, before < value ? value : before, false, __ATOMIC_RELAXED,
                                      __ATOMIC_RELAXED)) {
  }
  return before;
}
inline int __ffs(unsigned bits) { return __builtin_ffs(static_cast<int>(bits)); }
inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline int __popcll(unsigned long long bits) { return __builtin_popcountll(bits); }
