# The CUDA backend, as part of _native, and its emulation on the CPU, for tests.
set(BEAGS_CUDA AUTO CACHE STRING "Kernels for NVIDIA GPUs: ON, OFF, or AUTO, which is ON where nvcc is found.")
set(BEAGS_CUDA_ARCHITECTURES "75-real;80-real;86-real;89-real;90" CACHE STRING
    "GPUs that the kernels are compiled for, as CMAKE_CUDA_ARCHITECTURES; newer ones use the last one's PTX.")
option(BEAGS_CUDA_EMULATION "Build beags_plugin/_cuda_emulation, which runs the CUDA kernels on the CPU: for tests." OFF)

set(cuda ${sources}/cuda)
set(cuda_bindings ${sources}/binding/module_cuda.cpp ${sources}/binding/module_cuda_ops.cpp)

if(BEAGS_CUDA_EMULATION) # in a domain of its own, as its types have the names of those of _native
  nanobind_add_module(_cuda_emulation NB_STATIC NB_DOMAIN beags_emulation ${cuda}/emulation/emulated.cpp
                      ${sources}/binding/module_emulation.cpp ${cuda_bindings})
  target_include_directories(_cuda_emulation PRIVATE ${sources})
  target_compile_definitions(_cuda_emulation PRIVATE BEAGS_CUDA_EMULATION)
  target_compile_options(_cuda_emulation PRIVATE -O1 -ffp-contract=off -Wall -Wextra -Wno-unknown-pragmas)
  install(TARGETS _cuda_emulation LIBRARY DESTINATION beags_plugin)
endif()

if(NOT BEAGS_CUDA)
  message(STATUS "BEAGS_CUDA is OFF: beags is built without kernels for GPUs.")
  return()
endif()
if(BEAGS_CUDA_ARCHITECTURES STREQUAL "native" AND CMAKE_VERSION VERSION_LESS 3.24)
  message(FATAL_ERROR "BEAGS_CUDA_ARCHITECTURES=native needs CMake 3.24: name the architecture, such as 90.")
endif()
set(CMAKE_CUDA_ARCHITECTURES ${BEAGS_CUDA_ARCHITECTURES})
# nvcc may also come from pip: cuda-toolkit[nvcc] and nvidia-cuda-cccl.
if(NOT CMAKE_CUDA_COMPILER AND NOT DEFINED ENV{CUDACXX})
  file(GLOB from_pip "${Python_SITELIB}/nvidia/cu*/bin")
  find_program(BEAGS_NVCC nvcc PATHS /usr/local/cuda/bin ${from_pip})
  if(BEAGS_NVCC)
    set(ENV{CUDACXX} ${BEAGS_NVCC})
  endif()
endif()
check_language(CUDA)
if(CMAKE_CUDA_COMPILER)
  enable_language(CUDA)
  find_library(BEAGS_CUDART cudart_static HINTS ${CMAKE_CUDA_IMPLICIT_LINK_DIRECTORIES})
endif()
if(NOT CMAKE_CUDA_COMPILER OR NOT BEAGS_CUDART OR CMAKE_CUDA_COMPILER_VERSION VERSION_LESS 12)
  if(BEAGS_CUDA STREQUAL "AUTO")
    message(STATUS "There is no nvcc 12 or newer with a static CUDA runtime: beags is built without kernels for GPUs.")
    return()
  endif()
  message(FATAL_ERROR "BEAGS_CUDA is ON, but there is no nvcc 12 or newer with a static CUDA runtime.")
endif()
message(STATUS "Kernels for GPUs: ${CMAKE_CUDA_COMPILER} ${CMAKE_CUDA_COMPILER_VERSION}, for ${CMAKE_CUDA_ARCHITECTURES}")

set(kernels
    rasterizer/backward rasterizer/forward rasterizer/primitives rasterizer/project rasterizer/queries
    ops/normal_consistency ops/occupancy_loss ops/photometric ops/reprojection_votes ops/sh_colors ops/voxel_lookup
    ops/voxel_votes)
list(TRANSFORM kernels PREPEND ${cuda}/)
list(TRANSFORM kernels APPEND .cu)
add_library(beags_cuda STATIC ${kernels})
target_include_directories(beags_cuda PRIVATE ${sources})
set_target_properties(beags_cuda PROPERTIES CUDA_STANDARD 17 CUDA_STANDARD_REQUIRED ON POSITION_INDEPENDENT_CODE ON
                                            CUDA_VISIBILITY_PRESET hidden CUDA_RUNTIME_LIBRARY Static)
# No fused operations but explicit ones: the forward and the backward must evaluate a hit alike, to the last bit.
target_compile_options(beags_cuda PRIVATE -O3 --fmad=false --expt-relaxed-constexpr)
target_sources(_native PRIVATE ${cuda_bindings})
target_compile_definitions(_native PRIVATE BEAGS_HAS_CUDA)
set(compiled ${CMAKE_CUDA_ARCHITECTURES})
list(FILTER compiled EXCLUDE REGEX "-virtual$")
if(NOT compiled)
  target_compile_definitions(_native PRIVATE BEAGS_CUDA_PTX_ONLY)
endif()
# torch brings a CUDA runtime of its own: the names of ours stay inside.
find_package(Threads REQUIRED)
target_include_directories(_native SYSTEM PRIVATE ${CMAKE_CUDA_TOOLKIT_INCLUDE_DIRECTORIES})
target_link_libraries(_native PRIVATE beags_cuda ${BEAGS_CUDART} Threads::Threads ${CMAKE_DL_LIBS} rt
                                      "-Wl,--exclude-libs,ALL")
