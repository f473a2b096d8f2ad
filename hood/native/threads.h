// Work in parts, shared by threads that wait for it.
//
// A result depends on the number of parts alone: who computes a part does not matter, and where there are fewer cores than parts
// a thread takes several. Threads of our own, not OpenMP: compilers of macOS come without it, its threads do not survive a fork,
// and with passive waiting, which suits a busy machine, its barriers take as long as the shortest loops here. A thread that has
// nothing to do looks for work for a moment and then sleeps.
#pragma once
#include <pthread.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <mutex>
#include <system_error>
#include <thread>

namespace {

constexpr int64_t MOST_PARTS = 64;  // as in hood/native/arguments.py

inline void pause_briefly() {
#if defined(__x86_64__) || defined(__i386__)
    __builtin_ia32_pause();
#elif defined(__aarch64__)
    asm volatile("yield");
#endif
}

class Pool {
  public:
    typedef void (*Work)(const void* context, int64_t part);

    // The pool of this process: the threads of a parent do not exist in a child.
    static Pool& here() {
        Pool* pool = current().load(std::memory_order_acquire);
        if (pool) return *pool;
        static const int forgotten = pthread_atfork(nullptr, nullptr, [] { current() = nullptr; });
        (void)forgotten;
        Pool* fresh = new Pool;  // never deleted: its threads may wait as long as the process lives
        if (current().compare_exchange_strong(pool, fresh)) return *fresh;
        delete fresh;
        return *pool;
    }

    void run(int64_t parts, Work work, const void* context) {
        std::unique_lock<std::mutex> mine(busy_, std::try_to_lock);
        const int64_t helpers = mine.owns_lock() ? hire(std::min(parts, cores()) - 1) : 0;
        if (helpers) {
            work_ = work, context_ = context, parts_ = parts;
            left_.store(helpers, std::memory_order_relaxed);
            post(helpers);
        }
        for (int64_t part = 0; part < parts; part += helpers + 1) work(context, part);
        while (helpers && !look([&] { return left_.load(std::memory_order_acquire) == 0; })) {}
    }

  private:
    static std::atomic<Pool*>& current() {
        static std::atomic<Pool*> pool{nullptr};
        return pool;
    }

    // Whether something has happened after some microseconds. If not, another thread that waits for this core may have it.
    template <class Happened> static bool look(const Happened& happened) {
        for (int turn = 0; turn < 64; ++turn, pause_briefly())
            if (happened()) return true;
        std::this_thread::yield();
        return happened();
    }

    static constexpr std::chrono::microseconds PATIENCE{300};

    static int64_t cores() {
        static const int64_t count = std::max<int64_t>(std::thread::hardware_concurrency(), 1);
        return count;
    }

    // As many helpers as can be had.
    int64_t hire(int64_t wanted) {
        try {
            for (; hired_ < wanted; ++hired_) std::thread(&Pool::help, this, hired_ + 1, call_.load()).detach();
        } catch (const std::system_error&) {
        }
        return std::min(wanted, hired_);
    }

    // A call's number and, in its last bits, how many helpers it takes.
    void post(int64_t helpers) {
        call_.store(((call_.load() >> 8) + 1) << 8 | helpers);
        if (asleep_.load() == 0) return;
        { std::lock_guard<std::mutex> lock(sleep_); }
        wake_.notify_all();
    }

    int64_t next_call(int64_t seen) {
        const auto until = std::chrono::steady_clock::now() + PATIENCE;
        const auto called = [&] { return call_.load() != seen; };
        do {
            if (look(called)) return call_.load();
        } while (std::chrono::steady_clock::now() < until);
        std::unique_lock<std::mutex> lock(sleep_);
        ++asleep_;
        wake_.wait(lock, called);
        --asleep_;
        return call_.load();
    }

    void help(int64_t number, int64_t seen) {
        while (true) {
            seen = next_call(seen);
            const int64_t helpers = seen & 255;
            if (number > helpers) continue;  // the call may be over: nothing of it is looked at
            for (int64_t part = number; part < parts_; part += helpers + 1) work_(context_, part);
            left_.fetch_sub(1, std::memory_order_release);
        }
    }

    // What helpers read of a call, in one line of the cache, and what they write.
    alignas(64) std::atomic<int64_t> call_{0};
    Work work_ = nullptr;
    const void* context_ = nullptr;
    int64_t parts_ = 0;
    alignas(64) std::atomic<int64_t> left_{0};
    alignas(64) std::atomic<int64_t> asleep_{0};
    int64_t hired_ = 0;
    std::mutex busy_, sleep_;
    std::condition_variable wake_;
};

// compute(part) for every part; in turn where the threads are busy with another call.
template <class Compute> inline void for_parts(int64_t parts, const Compute& compute) {
    if (parts <= 1) return compute(0);
    Pool::here().run(parts, [](const void* context, int64_t part) { (*(const Compute*)context)(part); }, &compute);
}

struct Range {
    int64_t begin, end;
};

// A part of so many, in whole groups.
inline Range range_of(int64_t count, int64_t part, int64_t parts, int64_t group = 1) {
    const int64_t groups = (count + group - 1) / group;
    return {std::min(count, groups * part / parts * group), std::min(count, groups * (part + 1) / parts * group)};
}

}  // namespace
