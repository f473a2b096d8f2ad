// A stand-in accelerator for tests on machines without one: torch's PrivateUse1 device over ordinary memory.
//
// Every operation runs torch's own CPU kernel on the same memory, after the checks that a CUDA device would make:
// - an array of the CPU among those of the device is an error; numbers of the CPU (no dimensions) are allowed where
//   torch.cuda allows them (pointwise operations), and counted under "cpu scalar";
// - a generator of the CPU is an error;
// - fresh memory holds NaN, not zeros.
// Operations that make the host wait on CUDA are counted. While a graph is recorded they are errors; a recorded graph is
// replayed call by call on the memory of its recording, as CUDA does it.
#include <ATen/EmptyTensor.h>
#include <ATen/detail/PrivateUse1HooksInterface.h>
#include <ATen/ops/_reshape_alias_native.h>
#include <ATen/ops/as_strided_native.h>
#include <ATen/ops/set_native.h>
#include <ATen/ops/unfold_native.h>
#include <ATen/ops/view_native.h>
#include <c10/core/CPUAllocator.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <torch/library.h>

#include <cstdlib>
#include <cstring>
#include <functional>
#include <map>
#include <mutex>
#include <set>
#include <string>
#include <unordered_map>
#include <vector>

namespace {

using at::IValue;
using at::Tensor;
constexpr auto kKey = c10::DispatchKey::PrivateUse1;
constexpr auto kType = c10::DeviceType::PrivateUse1;
using Stack = torch::jit::Stack;
using Graph = std::vector<std::function<void()>>;

std::mutex lock;
std::map<std::string, int64_t> counts;
Graph* recording = nullptr;
std::map<int64_t, Graph> graphs;

void count(const std::string& name) {
  std::lock_guard<std::mutex> guard(lock);
  ++counts[name];
}

void wait_for(const std::string& what) {
  count("sync " + what);
  TORCH_CHECK(recording == nullptr, "standin: operation not permitted while a graph is recorded: ", what);
}

// ---- memory ---------------------------------------------------------------------------------------------------------

struct Memory final : c10::Allocator {
  c10::DataPtr allocate(size_t size) override {
    void* data = size == 0 ? nullptr : std::aligned_alloc(64, (size + 63) / 64 * 64);
    if (data != nullptr) std::memset(data, 0xFF, size);
    return {data, data, &std::free, c10::Device(kType, 0)};
  }
  c10::DeleterFnPtr raw_deleter() const override { return &std::free; }
  void copy_data(void* to, const void* from, size_t size) const override { default_copy_data(to, from, size); }
};
Memory memory;
REGISTER_ALLOCATOR(kType, &memory);

struct Guard final : c10::impl::DeviceGuardImplInterface {
  static constexpr c10::DeviceType static_type = kType;
  Guard() = default;
  explicit Guard(c10::DeviceType) {}
  c10::DeviceType type() const override { return kType; }
  c10::Device exchangeDevice(c10::Device) const override { return {kType, 0}; }
  c10::Device getDevice() const override { return {kType, 0}; }
  void setDevice(c10::Device) const override {}
  void uncheckedSetDevice(c10::Device) const noexcept override {}
  c10::Stream getStream(c10::Device) const override { return stream(); }
  c10::Stream getDefaultStream(c10::Device) const override { return stream(); }
  c10::Stream getStreamFromGlobalPool(c10::Device, bool) const override { return stream(); }
  c10::Stream getNewStream(c10::Device, int) const override { return stream(); }
  c10::Stream exchangeStream(c10::Stream) const override { return stream(); }
  void record(void**, const c10::Stream&, const c10::DeviceIndex, const c10::EventFlag) const override {}
  void block(void*, const c10::Stream&) const override {}
  bool queryEvent(void*) const override { return true; }
  void destroyEvent(void*, const c10::DeviceIndex) const noexcept override {}
  bool queryStream(const c10::Stream&) const override { return true; }
  void synchronizeStream(const c10::Stream&) const override {}
  void synchronizeEvent(void*) const override {}
  void synchronizeDevice(const c10::DeviceIndex) const override {}
  void recordDataPtrOnStream(const c10::DataPtr&, const c10::Stream&) const override {}
  c10::DeviceIndex deviceCount() const noexcept override { return 1; }

 private:
  static c10::Stream stream() { return c10::Stream(c10::Stream::DEFAULT, c10::Device(kType, 0)); }
};
C10_REGISTER_GUARD_IMPL(PrivateUse1, Guard);

struct Hooks final : at::PrivateUse1HooksInterface {
  bool isBuilt() const override { return true; }
  bool isAvailable() const override { return true; }
  bool hasPrimaryContext(c10::DeviceIndex) const override { return true; }
  c10::Allocator* getPinnedMemoryAllocator() const override { return c10::GetCPUAllocator(); }
  void resizePrivateUse1Bytes(const c10::Storage& storage, size_t size) const override {
    auto fresh = memory.allocate(size);
    if (size > 0 && storage.nbytes() > 0) std::memcpy(fresh.get(), storage.data(), std::min(size, storage.nbytes()));
    storage.set_data_ptr_noswap(std::move(fresh));
    storage.set_nbytes(size);
  }
};

// ---- the same memory, seen from both sides ----------------------------------------------------------------------------

Tensor over(const Tensor& source, c10::Device device, c10::Allocator* allocator, c10::DispatchKey key) {
  auto* keep = new c10::Storage(source.storage());
  c10::DataPtr data(const_cast<void*>(source.storage().data()), keep, [](void* it) { delete static_cast<c10::Storage*>(it); }, device);
  c10::Storage storage(c10::Storage::use_byte_size_t(), source.storage().nbytes(), std::move(data), allocator, true);
  auto result = at::detail::make_tensor<c10::TensorImpl>(std::move(storage), c10::DispatchKeySet(key), source.dtype());
  auto* impl = result.unsafeGetTensorImpl();
  impl->set_sizes_and_strides(source.sizes(), source.strides(), source.storage_offset());
  if (source.unsafeGetTensorImpl()->is_wrapped_number()) impl->set_wrapped_number(true);
  return result;
}

Tensor on_host(const Tensor& value) { return over(value, c10::kCPU, c10::GetCPUAllocator(), c10::DispatchKey::CPU); }
Tensor on_device(const Tensor& value) { return over(value, {kType, 0}, &memory, kKey); }

// ---- operations -------------------------------------------------------------------------------------------------------

// What makes the host wait on CUDA.
const std::set<std::string> kWaits = {
    "aten::_local_scalar_dense", "aten::nonzero", "aten::nonzero_numpy", "aten::masked_select", "aten::_unique2", "aten::_unique",
    "aten::unique_dim", "aten::unique_consecutive", "aten::unique_dim_consecutive", "aten::equal", "aten::is_nonzero",
    "aten::bincount", "aten::repeat_interleave", "aten::linalg_solve", "aten::linalg_cholesky", "aten::linalg_eigh",
    "aten::_linalg_eigh", "aten::_linalg_svd", "aten::linalg_lstsq", "aten::histc", "aten::multinomial",
};
// Where indices may be on the CPU.
const std::set<std::string> kIndexing = {"aten::index", "aten::_index_put_impl_", "aten::index_put_", "aten::_unsafe_index"};

bool is_mask(const Tensor& value) { return value.scalar_type() == at::kBool || value.scalar_type() == at::kByte; }

void check_host(const Tensor& value, const std::string& name, const c10::OperatorHandle& op, bool index) {
  if (!value.defined() || value.device().type() == kType || value.device().type() == c10::kMeta) return;
  if (value.dim() == 0 && !index) {
    count("cpu scalar " + name + (op.hasTag(at::Tag::pointwise) ? "" : " NOT POINTWISE"));
    return;
  }
  if (index) {
    wait_for("copy of cpu indices for " + name);
    return;
  }
  TORCH_CHECK(false, "standin: expected all tensors on one device, but ", name, " got an array of the ", value.device(), " of shape ",
              value.sizes());
}

void run(const c10::OperatorHandle& op, Stack* stack) { op.redispatchBoxed(c10::DispatchKeySet(c10::DispatchKey::CPU), stack); }

void fallback(const c10::OperatorHandle& op, Stack* stack) {
  const auto& schema = op.schema();
  const std::string name = schema.operator_name().name;
  const std::string full = name + (schema.overload_name().empty() ? "" : "." + schema.overload_name());
  count(full);
  const size_t num_args = schema.arguments().size(), begin = stack->size() - num_args;

  if (kWaits.count(name) && !(name == "aten::repeat_interleave" && !stack->back().isNone())) wait_for(full);

  std::unordered_map<c10::TensorImpl*, Tensor> seen;  // given tensor to host tensor
  std::vector<std::pair<Tensor, Tensor>> written;
  auto convert = [&](const Tensor& value, bool index) -> Tensor {
    if (!value.defined()) return value;
    check_host(value, full, op, index);
    if (value.device().type() != kType) return value;
    auto [place, fresh] = seen.emplace(value.unsafeGetTensorImpl(), Tensor());
    if (fresh) place->second = on_host(value);
    return place->second;
  };
  bool masks = false;
  for (size_t i = 0; i < num_args; ++i) {
    IValue& argument = (*stack)[begin + i];
    const bool index = kIndexing.count(name) && schema.arguments()[i].name() == "indices";
    const auto* alias = schema.arguments()[i].alias_info();
    if (argument.isTensor()) {
      Tensor given = argument.toTensor(), host = convert(given, index);
      if (alias != nullptr && alias->isWrite() && given.defined() && given.device().type() == kType) written.emplace_back(given, host);
      argument = host;
    } else if (argument.isTensorList()) {
      c10::List<Tensor> hosts;
      for (const Tensor& value : argument.toTensorVector()) {
        hosts.push_back(convert(value, index));
        if (alias != nullptr && alias->isWrite()) written.emplace_back(value, hosts.get(hosts.size() - 1));
      }
      argument = IValue(hosts);
    } else if (argument.isOptionalTensorList()) {
      c10::List<std::optional<Tensor>> hosts;
      for (const std::optional<Tensor>& value : argument.toOptionalTensorList()) {
        masks |= index && value.has_value() && value->defined() && is_mask(*value);
        hosts.push_back(value.has_value() ? std::optional<Tensor>(convert(*value, index)) : std::nullopt);
      }
      argument = IValue(hosts);
    } else if (argument.isDevice()) {
      argument = IValue(c10::Device(c10::kCPU));
    } else if (argument.isGenerator()) {
      TORCH_CHECK(false, "standin: ", full, " got a generator of the CPU for arrays of the device");
    }
  }
  if (masks) {
    // One mask and one number is written by masked_fill, which waits for nothing.
    bool number = name == "aten::_index_put_impl_" && (*stack)[begin + 2].toTensor().numel() == 1;
    if (!number) wait_for("mask in " + full);
  }
  std::vector<IValue> given;
  if (recording != nullptr) given.assign(stack->end() - static_cast<int64_t>(num_args), stack->end());

  run(op, stack);

  for (auto& [mine, host] : written) {
    if (host.sizes() == mine.sizes() && host.storage().data() == mine.storage().data()) continue;
    TORCH_CHECK(recording == nullptr || mine.numel() == 0, "standin: ", full, " resized its output while a graph is recorded");
    auto fresh = on_device(host);
    mine.unsafeGetTensorImpl()->set_storage_keep_dtype(fresh.storage());
    mine.unsafeGetTensorImpl()->set_sizes_and_strides(fresh.sizes(), fresh.strides(), fresh.storage_offset());
  }
  const size_t num_returns = schema.returns().size();
  std::vector<std::pair<size_t, Tensor>> made;
  auto give_back = [&](const Tensor& host) -> Tensor {
    if (!host.defined()) return host;
    for (const auto& [mine, known] : seen) {
      if (known.is_same(host)) return Tensor(c10::intrusive_ptr<c10::TensorImpl, c10::UndefinedTensorImpl>::reclaim_copy(mine));
      TORCH_CHECK(host.nbytes() == 0 || known.storage().unsafeGetStorageImpl() != host.storage().unsafeGetStorageImpl(), "standin: ", full,
                  " gives a view, which is not written out");
    }
    return on_device(host);
  };
  const size_t first = stack->size() - num_returns;
  for (size_t i = 0; i < num_returns; ++i) {
    IValue& value = (*stack)[first + i];
    if (value.isTensor()) {
      Tensor host = value.toTensor();
      bool known = false;
      for (const auto& entry : seen) known |= entry.second.is_same(host);
      if (!known && host.defined()) made.emplace_back(i, host);
      value = give_back(host);
    } else if (value.isTensorList()) {
      c10::List<Tensor> mine;
      for (const Tensor& host : value.toTensorVector()) mine.push_back(give_back(host));
      TORCH_CHECK(recording == nullptr, "standin: ", full, " gives a list, which cannot be recorded");
      value = IValue(mine);
    }
  }
  if (recording != nullptr) {
    recording->push_back([op, given, made, num_returns, full] {
      Stack again(given.begin(), given.end());
      run(op, &again);
      for (const auto& [i, target] : made) {
        Tensor value = again[again.size() - num_returns + i].toTensor();
        TORCH_CHECK(value.sizes() == target.sizes(), "standin: ", full, " gave another shape in a replay");
        at::NoGradGuard no_grad;
        target.copy_(value);
      }
    });
  }
}

Tensor empty(at::IntArrayRef size, std::optional<at::ScalarType> dtype, std::optional<at::Layout>, std::optional<at::Device>,
             std::optional<bool>, std::optional<at::MemoryFormat> format) {
  return at::detail::empty_generic(size, &memory, c10::DispatchKeySet(kKey), c10::dtype_or_default(dtype), format);
}

Tensor empty_strided(at::IntArrayRef size, at::IntArrayRef stride, std::optional<at::ScalarType> dtype, std::optional<at::Layout>,
                     std::optional<at::Device>, std::optional<bool>) {
  return at::detail::empty_strided_generic(size, stride, &memory, c10::DispatchKeySet(kKey), c10::dtype_or_default(dtype));
}

Tensor copy_from(const Tensor& source, const Tensor& target, bool non_blocking) {
  const bool down = target.device().type() != kType, up = source.device().type() != kType;
  if (up || down) {
    // On CUDA a copy to the device from memory that is not pinned waits as well, unless it is asked not to.
    std::string what = down ? "copy to cpu" : "copy to device";
    if (down || !non_blocking) wait_for(what);
  }
  count("copy");
  Tensor from = up ? source : on_host(source), to = down ? target : on_host(target);
  at::NoGradGuard no_grad;
  auto go = [from, to] { at::NoGradGuard inside; to.copy_(from); };
  go();
  if (recording != nullptr) recording->push_back(go);
  return target;
}

Tensor copy_and_resize(const Tensor& source, const Tensor& target) {
  target.resize_(source.sizes());
  return copy_from(source, target, false);
}

const Tensor& resize(const Tensor& self, at::IntArrayRef size, std::optional<at::MemoryFormat> format) {
  TORCH_CHECK(!format.has_value() || *format == at::MemoryFormat::Contiguous, "standin: resize_ with a memory format");
  if (self.sizes() == size) return self;
  auto* impl = self.unsafeGetTensorImpl();
  impl->set_sizes_contiguous(size);
  const size_t needed = (self.storage_offset() + self.numel()) * self.element_size();
  if (needed > self.storage().nbytes()) at::detail::getPrivateUse1Hooks().resizePrivateUse1Bytes(self.storage(), needed);
  return self;
}

Tensor& set_storage(Tensor& self, at::Storage source, int64_t offset, at::IntArrayRef size, at::IntArrayRef stride) {
  return at::native::set_storage_cpu_(self, std::move(source), offset, size, stride);
}

Tensor& set_source(Tensor& self, at::Storage source) {
  int64_t length = static_cast<int64_t>(source.nbytes() / self.element_size());
  return at::native::set_storage_cpu_(self, std::move(source), 0, {length}, {});
}

Tensor& set_tensor(Tensor& self, const Tensor& source) { return at::native::set_tensor_(self, source); }

Tensor& set_nothing(Tensor& self) {
  c10::Storage nothing(c10::Storage::use_byte_size_t(), 0, memory.allocate(0), &memory, true);
  return at::native::set_storage_cpu_(self, nothing, 0, {0}, {});
}

TORCH_LIBRARY_IMPL(_, PrivateUse1, m) { m.fallback(torch::CppFunction::makeFromBoxedFunction<&fallback>()); }

TORCH_LIBRARY_IMPL(aten, PrivateUse1, m) {
  m.impl("empty.memory_format", &empty);
  m.impl("empty_strided", &empty_strided);
  m.impl("_copy_from", &copy_from);
  m.impl("_copy_from_and_resize", &copy_and_resize);
  m.impl("resize_", &resize);
  m.impl("set_.source_Storage", &set_source);
  m.impl("set_.source_Storage_storage_offset", &set_storage);
  m.impl("set_.source_Tensor", &set_tensor);
  m.impl("set_", &set_nothing);
  m.impl("view", [](const Tensor& self, at::IntArrayRef size) { return at::native::view(self, size); });
  m.impl("as_strided", [](const Tensor& self, at::IntArrayRef size, at::IntArrayRef stride, std::optional<int64_t> offset) {
    return at::native::as_strided_tensorimpl(self, size, stride, offset);
  });
  m.impl("_reshape_alias",
         [](const Tensor& self, at::IntArrayRef size, at::IntArrayRef stride) { return at::native::_reshape_alias(self, size, stride); });
  m.impl("unfold", [](const Tensor& self, int64_t dim, int64_t size, int64_t step) { return at::native::unfold(self, dim, size, step); });
}

// ---- graphs -----------------------------------------------------------------------------------------------------------

int64_t next_graph = 0;

int64_t begin_graph() {
  TORCH_CHECK(recording == nullptr, "standin: a graph is being recorded already");
  recording = &graphs[++next_graph];
  return next_graph;
}

// ---- what Python asks ---------------------------------------------------------------------------------------------------

void replay(int64_t graph) {
  TORCH_CHECK(recording == nullptr, "standin: a graph is replayed while another is recorded");
  for (const auto& call : graphs.at(graph)) call();
}

c10::Dict<std::string, int64_t> told() {
  std::lock_guard<std::mutex> guard(lock);
  c10::Dict<std::string, int64_t> result;
  for (const auto& [name, number] : counts) result.insert(name, number);
  return result;
}

const bool registered = [] {
  static Hooks hooks;
  at::RegisterPrivateUse1HooksInterface(&hooks);
  return true;
}();

}  // namespace

TORCH_LIBRARY(standin, m) {
  m.def("counts", &told);
  m.def("forget", [] { counts.clear(); });
  m.def("wait_for", [](const std::string& what) { wait_for(what); });
  m.def("is_recording", [] { return recording != nullptr; });
  m.def("begin_graph", &begin_graph);
  m.def("end_graph", [] { recording = nullptr; });
  m.def("length", [](int64_t graph) { return static_cast<int64_t>(graphs.at(graph).size()); });
  m.def("replay", &replay);
  m.def("drop", [](int64_t graph) { graphs.erase(graph); });
}
