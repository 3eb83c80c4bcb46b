// Defines the module beags_plugin._cuda_emulation, which runs the CUDA kernels on the CPU, for tests.
#include "binding/module_cuda.h"

NB_MODULE(_cuda_emulation, m) {
  nanobind::set_leak_warnings(false);
  m.doc() = "The CUDA kernels run by an emulation of CUDA on the CPU: for tests, not for use.";
  beags::bind_cuda(m);
}
