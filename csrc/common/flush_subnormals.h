#pragma once

#include <cstdint>

#ifdef __SSE__
#include <xmmintrin.h>
#endif

namespace diffcloth {

/// Scope in which subnormal numbers are flushed to zero in this thread: arithmetic with them is many
/// times slower on some processors. No effect on processors without such a mode.
class FlushSubnormals {
 public:
  FlushSubnormals() : before_(get()) { set(before_ | kFlags); }
  ~FlushSubnormals() { set(before_); }
  FlushSubnormals(const FlushSubnormals&) = delete;
  FlushSubnormals& operator=(const FlushSubnormals&) = delete;

 private:
#if defined(__SSE__)
  using Register = unsigned int;
  static constexpr Register kFlags = 0x8040;  // results and operands
  static Register get() { return _mm_getcsr(); }
  static void set(Register value) { _mm_setcsr(value); }
#elif defined(__aarch64__)
  using Register = std::uint64_t;
  static constexpr Register kFlags = std::uint64_t{1} << 24;
  static Register get() {
    Register value;
    asm volatile("mrs %0, fpcr" : "=r"(value));
    return value;
  }
  static void set(Register value) { asm volatile("msr fpcr, %0" : : "r"(value)); }
#else
  using Register = unsigned int;
  static constexpr Register kFlags = 0;
  static Register get() { return 0; }
  static void set(Register /*value*/) {}
#endif

  Register before_;
};

}  // namespace diffcloth
