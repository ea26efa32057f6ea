// A loop of 1 kHz without a robot: reads a schedule, serves ticks under a swinging force, and says how long they took.
//
//     g++ -std=c++17 -O2 -Icpp cpp/examples/loop.cpp -o loop && ./loop schedule.csv
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <new>
#include <torch_pbd/admittance.hpp>

namespace {

using Clock = std::chrono::steady_clock;

double microseconds(Clock::time_point start) {
    return std::chrono::duration<double, std::micro>(Clock::now() - start).count();
}

long n_allocations = 0;

template <std::size_t N, std::size_t M = N>
void run(const torch_pbd::Schedule& schedule) {
    torch_pbd::Admittance<N, M> controller(schedule);
    const int n_ticks = static_cast<int>(1000.0 * (schedule.time.back() - schedule.time.front())) + 2000;
    std::vector<double> times(static_cast<std::size_t>(n_ticks));
    const long before = n_allocations;
    controller.start(0.0);
    for (int i = 0; i < n_ticks; ++i) {
        torch_pbd::Vector<N> force;
        force.fill(2.0 * std::sin(0.01 * i));
        const auto start = Clock::now();
        controller.tick(1e-3 * (i + 1), force);
        times[static_cast<std::size_t>(i)] = microseconds(start);
    }
    const long allocated = n_allocations - before;
    std::sort(times.begin(), times.end());
    std::printf("%d ticks of %zu axes: median %.3f us, 99.9 %% within %.3f us, longest %.1f us\n", n_ticks, N,
                times[times.size() / 2], times[times.size() * 999 / 1000], times.back());
    std::printf("%ld allocations; faults %u\n", allocated, controller.faults());
}

}  // namespace

// Whoever allocates is counted.
[[gnu::noinline]] void* operator new(std::size_t size) {
    ++n_allocations;
    if (void* memory = std::malloc(size)) return memory;
    throw std::bad_alloc();
}
[[gnu::noinline]] void operator delete(void* memory) noexcept { std::free(memory); }
[[gnu::noinline]] void operator delete(void* memory, std::size_t) noexcept { std::free(memory); }

int main(int n_arguments, char** arguments) {
    if (n_arguments != 2) return std::fprintf(stderr, "usage: loop SCHEDULE.csv\n"), 2;
    try {
        const auto start = Clock::now();
        const auto schedule = torch_pbd::Schedule::load(arguments[1]);
        std::printf("%zu rows read in %.1f ms\n", schedule.n_rows, 1e-3 * microseconds(start));
        const bool is_pose = !schedule.orientation.empty();
        switch (schedule.n_outputs) {
            case 2: run<2>(schedule); break;
            case 6: is_pose ? run<6, 7>(schedule) : run<6>(schedule); break;
            default: return std::fprintf(stderr, "this example has 2 and 6 axes\n"), 1;
        }
    } catch (const std::exception& error) {
        return std::fprintf(stderr, "%s\n", error.what()), 1;
    }
}
