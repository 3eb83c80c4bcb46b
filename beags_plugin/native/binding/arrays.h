// Converts Python's tensors to plain pointers, for the files that bind the module.
#pragma once

#include <nanobind/nanobind.h>

#include <cstdint>
#include <type_traits>

namespace beags {

// The kind of memory that holds a tensor.
enum class Memory { kCpu, kCuda };

// A contiguous torch tensor. It reads the tensor's own attributes, which takes a tenth of the time of the DLPack
// protocol; that matters for calls with tens of tensors and little work. It holds no reference: the caller keeps the
// tensor alive.
template <class T, Memory kMemory = Memory::kCpu>
class Array {
 public:
  T* data() const { return data_; }  // null for None and for tensors without elements
  int64_t shape(int axis) const { return shape_[axis]; }

 private:
  friend struct nanobind::detail::type_caster<Array<T, kMemory>>;
  static constexpr int kAxes = 3;
  T* data_ = nullptr;
  int64_t shape_[kAxes] = {};  // sizes of the first axes
};

using Ids = Array<const int32_t>;  // class ids

// The attributes that are read from a tensor; made at the first call, never freed.
struct TensorNames {
  PyObject *tensor, *data_ptr, *dtype, *is_cpu, *is_cuda, *is_contiguous,
      *shape;  // tensor: the class; the others: attributes
  PyObject *float32, *float64, *boolean, *uint8, *int32, *int64;

  static const TensorNames& get() {
    static const TensorNames names = [] {
      const nanobind::module_ torch = nanobind::module_::import_("torch");
      const auto own = [&](const char* name) { return torch.attr(name).inc_ref().ptr(); };
      const auto text = [](const char* name) { return PyUnicode_InternFromString(name); };
      return TensorNames{own("Tensor"),         text("data_ptr"), text("dtype"),  text("is_cpu"), text("is_cuda"),
                         text("is_contiguous"), text("shape"),    own("float32"), own("float64"), own("bool"),
                         own("uint8"),          own("int32"),     own("int64")};
    }();
    return names;
  }

  template <class T>
  PyObject* dtype_of() const {
    if constexpr (std::is_same_v<T, float>) return float32;
    if constexpr (std::is_same_v<T, double>) return float64;
    if constexpr (std::is_same_v<T, bool>) return boolean;
    if constexpr (std::is_same_v<T, uint8_t>) return uint8;
    if constexpr (std::is_same_v<T, int32_t>) return int32;
    if constexpr (std::is_same_v<T, int64_t>) return int64;
  }
};

template <class T>
constexpr auto dtype_name() {
  using nanobind::detail::const_name;
  if constexpr (std::is_same_v<T, float>) return const_name("float32");
  if constexpr (std::is_same_v<T, double>) return const_name("float64");
  if constexpr (std::is_same_v<T, bool>) return const_name("bool");
  if constexpr (std::is_same_v<T, uint8_t>) return const_name("uint8");
  if constexpr (std::is_same_v<T, int32_t>) return const_name("int32");
  if constexpr (std::is_same_v<T, int64_t>) return const_name("int64");
}

}  // namespace beags

namespace nanobind {
namespace detail {

// Accepts contiguous tensors of T in that memory; nanobind raises TypeError for others. Each argument states whether
// None is allowed. The emulated GPU uses the CPU's memory.
template <class T, beags::Memory kMemory>
struct type_caster<beags::Array<T, kMemory>> {
#if defined(BEAGS_CUDA_EMULATION)
  static constexpr bool kOnCpu = true;
#else
  static constexpr bool kOnCpu = kMemory == beags::Memory::kCpu;
#endif
  using Tensor = beags::Array<T, kMemory>;
  using Element = std::remove_const_t<T>;
  NB_TYPE_CASTER(Tensor, const_name("torch.Tensor[") + beags::dtype_name<Element>() +
                             const_name<kOnCpu>(", contiguous, cpu]", ", contiguous, cuda]"))

  bool from_python(handle source, uint8_t, cleanup_list*) noexcept {
    value = {};
    if (source.is_none()) return true;
    try {
      const beags::TensorNames& names = beags::TensorNames::get();
      PyObject* tensor = source.ptr();
      if (!PyObject_TypeCheck(tensor, reinterpret_cast<PyTypeObject*>(names.tensor))) return false;
      if (attribute(tensor, names.dtype).ptr() != names.dtype_of<Element>()) return false;
      if (attribute(tensor, kOnCpu ? names.is_cpu : names.is_cuda).ptr() != Py_True) return false;
      if (call(tensor, names.is_contiguous).ptr() != Py_True) return false;
      const object shape = attribute(tensor, names.shape);
      const Py_ssize_t axes = PyTuple_Size(shape.ptr());
      for (Py_ssize_t axis = 0; axis < axes && axis < Tensor::kAxes; ++axis) {
        value.shape_[axis] = PyLong_AsLongLong(PyTuple_GetItem(shape.ptr(), axis));
      }
      value.data_ = static_cast<T*>(PyLong_AsVoidPtr(call(tensor, names.data_ptr).ptr()));
      if (PyErr_Occurred()) raise_python_error();
      return true;
    } catch (python_error&) {  // a tensor without storage; leaving the handler drops Python's error
      return false;
    } catch (...) {
      PyErr_Clear();
      return false;
    }
  }

 private:
  static object checked(PyObject* found) {
    if (!found) raise_python_error();
    return steal(found);
  }
  static object attribute(PyObject* tensor, PyObject* name) { return checked(PyObject_GetAttr(tensor, name)); }
  static object call(PyObject* tensor, PyObject* name) {
    PyObject* arguments[] = {tensor};
    return checked(PyObject_VectorcallMethod(name, arguments, 1, nullptr));
  }
};

}  // namespace detail
}  // namespace nanobind
