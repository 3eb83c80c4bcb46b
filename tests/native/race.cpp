// A race in a parallel loop: scripts/sanitize.sh asks whether the thread sanitizer sees it.
int main() {
  int sum = 0;
#pragma omp parallel for num_threads(2) schedule(static)
  for (int i = 0; i < 2; ++i) sum += i + 1;
  return sum == 0;
}
