#include "bind/without_gil.h"

#include <atomic>
#include <chrono>
#include <mutex>
#include <thread>

namespace diffcloth::bind {
namespace {

using namespace std::chrono_literals;

/// State shared by all threads; never destroyed, because threads read it during process exit.
struct Parking {
  std::atomic<bool> abandoned{false};
  std::atomic<unsigned long> closer{0};  // the only thread that may return; set before `abandoned`
  std::mutex mutex;
  std::vector<unsigned long> parked;  // guarded by the mutex
};

Parking& parking() {
  static auto* const only = new Parking;
  return *only;
}

}  // namespace

WithoutGil::~WithoutGil() {
  if (is_abandoned()) {
    {
      const std::lock_guard lock(parking().mutex);
      parking().parked.push_back(PyThread_get_thread_ident());
    }
    for (;;) std::this_thread::sleep_for(1h);
  }
  PyEval_RestoreThread(state_);
}

void abandon_calls() {
  parking().closer = PyThread_get_thread_ident();
  parking().abandoned = true;
}

bool is_abandoned() {
  return parking().abandoned && parking().closer != PyThread_get_thread_ident();
}

std::vector<unsigned long> parked_threads() {
  const std::lock_guard lock(parking().mutex);
  return parking().parked;
}

}  // namespace diffcloth::bind
