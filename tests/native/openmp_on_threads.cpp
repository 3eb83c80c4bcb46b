// The part of GCC's OpenMP runtime that the extension uses, on plain threads: for the thread sanitizer, which does not
// see how libgomp's own threads wait for one another and would call every parallel loop a race. Chunks are claimed
// without any ordering, so that only barriers and the ends of threads order anything, as OpenMP promises.
#include <pthread.h>

#include <atomic>
#include <cstdlib>
#include <thread>
#include <vector>

namespace {

constexpr int kMostLoops = 64;  // work-sharing loops in one parallel region

struct Team {
  int size;
  pthread_barrier_t barrier;
  std::atomic<long> claimed[kMostLoops] = {};  // chunks of each loop
};

struct Loop {
  long start, end, step, chunk;
};

thread_local Team* team = nullptr;
thread_local int member = 0, loop_number = 0;
thread_local Loop loop;

bool claim(long* first, long* last) {
  if (loop_number >= kMostLoops) std::abort();
  const long index = team->claimed[loop_number].fetch_add(1, std::memory_order_relaxed);
  const long at = loop.start + index * loop.chunk * loop.step;
  if (loop.step > 0 ? at >= loop.end : at <= loop.end) return false;
  const long until = at + loop.chunk * loop.step;
  *first = at;
  *last = loop.step > 0 ? (until < loop.end ? until : loop.end) : (until > loop.end ? until : loop.end);
  return true;
}

void run(void (*work)(void*), void* data, unsigned threads, const Loop& given) {
  Team here;
  here.size = threads ? static_cast<int>(threads) : 2;
  pthread_barrier_init(&here.barrier, nullptr, here.size);
  const auto one = [&](int index) {
    team = &here;
    member = index;
    loop_number = 0;
    loop = given;
    work(data);
    team = nullptr;
    member = 0;
  };
  std::vector<std::thread> others;
  for (int i = 1; i < here.size; ++i) others.emplace_back(one, i);
  one(0);
  for (std::thread& other : others) other.join();
  pthread_barrier_destroy(&here.barrier);
}

}  // namespace

extern "C" {

int omp_get_thread_num() { return member; }
int omp_get_num_threads() { return team ? team->size : 1; }

void GOMP_barrier() {
  if (team) pthread_barrier_wait(&team->barrier);
}

void GOMP_parallel(void (*work)(void*), void* data, unsigned threads, unsigned) { run(work, data, threads, {}); }

void GOMP_parallel_loop_nonmonotonic_dynamic(void (*work)(void*), void* data, unsigned threads, long start, long end,
                                             long step, long chunk, unsigned) {
  run(work, data, threads, {start, end, step, chunk});
}

bool GOMP_loop_nonmonotonic_dynamic_start(long start, long end, long step, long chunk, long* first, long* last) {
  loop = {start, end, step, chunk};
  return claim(first, last);
}

bool GOMP_loop_nonmonotonic_dynamic_next(long* first, long* last) { return claim(first, last); }

void GOMP_loop_end_nowait() { ++loop_number; }

void GOMP_loop_end() {
  ++loop_number;
  GOMP_barrier();
}

}  // extern "C"
