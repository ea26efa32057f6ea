// The controller in C, for ctypes: `bridge.py` has the other end.
#include <cstdio>
#include <exception>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <torch_pbd/admittance.hpp>
#include <type_traits>
#include <vector>

using torch_pbd::Admittance;
using torch_pbd::Matrix;
using torch_pbd::Options;
using torch_pbd::Schedule;
using torch_pbd::Vector;

namespace {

struct Loop {
    virtual ~Loop() = default;
    virtual void start(double now, const double* place, const double* velocity, double at, const double* bias) = 0;
    virtual unsigned tick(double now, const double* force) = 0;
    virtual void read(double* out) const = 0;
};

template <std::size_t N>
Vector<N> vector(const double* values) {
    Vector<N> result{};
    if (values) std::copy(values, values + N, result.begin());
    return result;
}

template <std::size_t N, std::size_t M = N>
struct LoopOf final : Loop {
    LoopOf(const Schedule& schedule, const Options& options) : controller(schedule, options) {}

    // A place that begins or ends with NaN has no position or orientation.
    void start(double now, const double* place, const double* velocity, double at, const double* bias) override {
        typename Admittance<N, M>::Start from;
        constexpr std::size_t p = torch_pbd::n_positions<N, M>;
        if (place[0] == place[0]) from.position = vector<p>(place);
        if (M != N && place[M - 1] == place[M - 1]) from.orientation = vector<4>(place + M - 4);
        from.velocity = vector<N>(velocity);
        from.force_bias = vector<N>(bias);
        from.at = at;
        controller.start(now, from);
    }

    unsigned tick(double now, const double* force) override { return controller.tick(now, vector<N>(force)); }

    void read(double* out) const override {
        const auto add = [&out](const auto& part) { out = std::copy(part.begin(), part.end(), out); };
        *out++ = controller.schedule_time();
        add(controller.position());
        if constexpr (M != N) add(controller.orientation());
        add(controller.velocity());
        add(controller.force());
        add(controller.desired_position());
        if constexpr (M != N) add(controller.desired_orientation());
        add(controller.desired_velocity());
        for (const Matrix<N>& gain : {controller.stiffness(), controller.damping()})
            for (const Vector<N>& row : gain) add(row);
    }

    Admittance<N, M> controller;
};

// Options in the order of their declaration, two numbers each, of which most use one; NaN is the default.
Options as_options(const double* values) {
    Options options;
    const auto is_given = [&values] { return values[0] == values[0]; };
    const auto set = [&](auto& option) {
        if (is_given()) option = static_cast<std::decay_t<decltype(option)>>(values[0]);
        values += 2;
    };
    const auto set_limit = [&](auto& option) {
        if (is_given()) option = torch_pbd::Limit{values[0], values[1]};
        values += 2;
    };
    if (is_given()) options.mass = values[0];
    values += 2;
    set(options.rate);
    set(options.max_step);
    set_limit(options.force_limit);
    set_limit(options.deadband);
    set_limit(options.spring_limit);
    set_limit(options.velocity_limit);
    set_limit(options.acceleration_limit);
    set(options.hold_ticks);
    set(options.max_bad_ticks);
    set_limit(options.stop_deceleration);
    set(options.soft_start);
    set_limit(options.approach_speed);
    set(options.catches_up);
    set_limit(options.force_rate_limit);
    return options;
}

std::unique_ptr<Loop> make(const Schedule& schedule, const Options& options) {
    if (!schedule.orientation.empty()) return std::make_unique<LoopOf<6, 7>>(schedule, options);
    switch (schedule.n_outputs) {
        case 1: return std::make_unique<LoopOf<1>>(schedule, options);
        case 2: return std::make_unique<LoopOf<2>>(schedule, options);
        case 3: return std::make_unique<LoopOf<3>>(schedule, options);
        case 6: return std::make_unique<LoopOf<6>>(schedule, options);
        default: throw std::invalid_argument("the bridge has 1, 2, 3 and 6 axes");
    }
}

// Errors are said in the text, which has room for 500 letters.
template <typename Call>
auto said(char* text, Call call) -> decltype(call()) {
    try {
        return call();
    } catch (const std::exception& error) {
        std::snprintf(text, 500, "%s", error.what());
        return {};
    }
}

}  // namespace

extern "C" {

Loop* create(const char* path, const double* options, char* text) {
    return said(text, [&] { return make(Schedule::load(path), as_options(options)).release(); });
}

// Number of values of an array of a file, 0 where it has none; `out`, if there is one, has room for them.
long read_array(const char* path, const char* name, double* out, char* text) {
    const std::vector<double> values = said(text, [&] {
        Schedule schedule = Schedule::load(path);
        const std::map<std::string, std::vector<double>*> arrays{
            {"time", &schedule.time},
            {"position", &schedule.position},
            {"velocity", &schedule.velocity},
            {"stiffness", &schedule.stiffness},
            {"damping", &schedule.damping},
            {"covariance", &schedule.covariance},
            {"type1", &schedule.type1},
            {"acceleration", &schedule.acceleration},
            {"orientation", &schedule.orientation},
            {"mass", &schedule.inertia},
        };
        return *arrays.at(name);
    });
    if (out) std::copy(values.begin(), values.end(), out);
    return static_cast<long>(values.size());
}

void destroy(Loop* loop) { delete loop; }

bool start(Loop* loop, double now, const double* place, const double* velocity, double at, const double* bias,
           char* text) {
    return said(text, [&] {
        loop->start(now, place, velocity, at, bias);
        return true;
    });
}

unsigned tick(Loop* loop, double now, const double* force, double* out) {
    const unsigned faults = loop->tick(now, force);
    loop->read(out);
    return faults;
}

}  // extern "C"
