/// A schedule of motion and gains, as `Schedule.save("....csv")` of Python writes it.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <fstream>
#include <istream>
#include <map>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "csv.hpp"

namespace torch_pbd {

/// Motion and gains over time, with the covariance they come from; rows stand one after another.
///
/// Of positions alone, d = p, or of poses, d = p + 3: twists and gains have the positions first, then rotations.
struct Schedule {
    std::size_t n_rows = 0, n_positions = 0, n_outputs = 0;  ///< n, p, d
    std::vector<double> time;  ///< (n,), in s, increasing
    std::vector<double> position;  ///< (n, p), in units
    std::vector<double> velocity;  ///< (n, d), in units/s and rad/s
    std::vector<double> stiffness, damping;  ///< (n, d, d), in N/m, Nm/rad and N s/m, Nm s/rad
    std::vector<double> covariance;  ///< (n, d, d), of the demonstrations
    std::vector<double> type1;  ///< (n,), how little the model knew, 0 to 1
    std::vector<double> acceleration;  ///< (n, d), in units/s^2 and rad/s^2, or empty
    std::vector<double> orientation;  ///< (n, 4), unit quaternions w x y z of one sign along the rows, or empty
    std::optional<double> mass;  ///< virtual mass that the damping is for, in kg
    std::vector<double> inertia;  ///< (n, d, d), inertia that it is for instead, in kg, kg m and kg m^2, or empty
    std::map<std::string, std::string> labels;  ///< of the file, in JSON: names, units, frame, ...

    /// Reads a .csv of Python; throws std::runtime_error where it is none, torn, changed, or of a newer format.
    static Schedule load(const std::string& path);
};

namespace file {

/// Whether eigenvalues of a symmetric (d, d) matrix are all above a bound: whether A - bound has a Cholesky factor.
inline bool eigenvalues_above(const double* matrix, std::size_t d, double bound) {
    std::vector<double> a(matrix, matrix + d * d);
    for (std::size_t j = 0; j < d; ++j) {
        a[j * d + j] -= bound;
        for (std::size_t k = 0; k < j; ++k) a[j * d + j] -= a[j * d + k] * a[j * d + k];
        if (!(a[j * d + j] > 0.0)) return false;
        a[j * d + j] = std::sqrt(a[j * d + j]);
        for (std::size_t i = j + 1; i < d; ++i) {
            for (std::size_t k = 0; k < j; ++k) a[i * d + j] -= a[i * d + k] * a[j * d + k];
            a[i * d + j] /= a[j * d + j];
        }
    }
    return true;
}

/// Refuses what no robot can follow, as Python does: times that stand, negative gains, rows that nothing holds.
inline void check(const Schedule& schedule) {
    constexpr double rounding = 1e-9;
    const std::size_t d = schedule.n_outputs;
    const auto row_error = [](const std::string& name, std::size_t row, const char* must) {
        throw std::runtime_error(name + " of row " + std::to_string(row) + " must be " + must);
    };
    if (d == 0 || schedule.n_rows < 2) throw std::runtime_error("it must have 2 rows and 1 output at least");
    for (std::size_t row = 0; row < schedule.n_rows; ++row) {
        if (row > 0 && !(schedule.time[row] > schedule.time[row - 1]))
            row_error("time", row, "later than the one before");
        bool is_held = false;
        for (const auto& [name, gains] :
             {std::pair{"stiffness", &schedule.stiffness}, {"damping", &schedule.damping}}) {
            const double* gain = &(*gains)[row * d * d];
            double scale = 0.0;
            for (std::size_t i = 0; i < d * d; ++i) scale = std::max(scale, std::abs(gain[i]));
            if (!eigenvalues_above(gain, d, scale > 0.0 ? -rounding * scale : -1.0))
                row_error(name, row, "positive semidefinite");
            is_held = is_held || eigenvalues_above(gain, d, rounding * scale);
        }
        if (!is_held) row_error("damping", row, "above zero where the stiffness is singular");
        if (!schedule.inertia.empty() && !eigenvalues_above(&schedule.inertia[row * d * d], d, 0.0))
            row_error("mass", row, "positive definite");
    }
}

/// Makes quaternions unit ones to the last bit, each with the sign that is nearer to the one before.
inline void make_continuous(std::vector<double>& orientation) {
    constexpr double nearly_unit = 1e-6, unit = 1e-14;  // of the squared norm
    for (std::size_t row = 0; row + 3 < orientation.size(); row += 4) {
        double* q = &orientation[row];
        const double square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
        if (!(std::abs(square - 1.0) <= nearly_unit))
            throw std::runtime_error("orientation of row " + std::to_string(row / 4) + " must be of norm 1");
        double scale = std::abs(square - 1.0) > unit ? 1.0 / std::sqrt(square) : 1.0;
        if (row > 0 && q[0] * q[-4] + q[1] * q[-3] + q[2] * q[-2] + q[3] * q[-1] < 0.0) scale = -scale;
        for (int i = 0; i < 4; ++i) q[i] *= scale;
    }
}

inline Schedule read(std::istream& stream) {
    Schedule schedule;
    std::string line;
    std::size_t n_lines = 0;
    const auto next = [&] {
        if (!std::getline(stream, line)) return false;
        ++n_lines;
        if (!line.empty() && line.back() == '\r') line.pop_back();
        if (n_lines == 1 && line.compare(0, 3, "\xef\xbb\xbf") == 0) line.erase(0, 3);
        return true;
    };
    while (next() && line.compare(0, 2, "# ") == 0) {
        const std::size_t colon = std::min(line.find(": "), line.size() - 2);
        if (!schedule.labels.emplace(line.substr(2, colon - 2), line.substr(colon + 2)).second)
            throw std::runtime_error("line " + std::to_string(n_lines) + " has a label that was there before");
    }
    const auto label = [&schedule](const char* key) {
        const auto found = schedule.labels.find(key);
        return found == schedule.labels.end() ? std::string() : found->second;
    };
    if (label("format") != "\"torch_pbd.schedule\"") throw std::runtime_error("it is no schedule");
    if (label("version") != "2")
        throw std::runtime_error("it has version " + label("version") + ", must have 2: save it anew by this Python");
    Table table(line);
    while (next())
        if (!line.empty()) table.add(line, n_lines);
    const std::vector<std::string> positions = table.places("position"), outputs = table.places("velocity");
    const bool is_pose = !table.places("orientation").empty();
    const std::size_t n = schedule.n_rows = table.n_rows, p = schedule.n_positions = positions.size();
    const std::size_t d = schedule.n_outputs = outputs.size();
    if (d != p + (is_pose ? 3 : 0) || !std::equal(positions.begin(), positions.end(), outputs.begin()))
        throw std::runtime_error("its columns of velocity are not those of position, and three of an orientation");
    // SHA-256 of what a file says, not of how it is written: line ends and spelling of numbers are free.
    Sha256 digest;
    digest.update(header_of(schedule.labels));
    const std::string rows = std::to_string(n), columns = ", " + std::to_string(d);
    const auto digested = [&](const std::string& name, const std::string& shape, std::vector<double> values) {
        digest.update(name + " (" + shape + ") ");
        digest.update(values);
        return values;
    };
    const auto take = [&](const std::string& name, const std::vector<std::string>& places) {
        std::vector<std::string> titles;
        for (const std::string& place : places) titles.push_back(name + "[" + place + "]");
        if (places.empty()) return digested(name, rows + ",", table.take(name, {name}));
        return digested(name, rows + ", " + std::to_string(places.size()), table.take(name, titles));
    };
    const auto take_matrices = [&](const std::string& name) {
        return digested(name, rows + columns + columns, table.take_matrices(name, outputs));
    };
    schedule.time = take("time", {});
    schedule.position = take("position", positions);
    schedule.velocity = take("velocity", outputs);
    schedule.stiffness = take_matrices("stiffness");
    schedule.damping = take_matrices("damping");
    schedule.covariance = take_matrices("covariance");
    schedule.type1 = take("type1", {});
    if (!table.places("acceleration").empty()) schedule.acceleration = take("acceleration", outputs);
    if (is_pose) schedule.orientation = take("orientation", {"w", "x", "y", "z"});
    if (!table.places("mass").empty()) schedule.inertia = take_matrices("mass");
    if (!table.is_taken()) throw std::runtime_error("it has columns that are unknown");
    if (label("mass") != "null") schedule.mass = number(label("mass"), 1);
    if (!label("sha256").empty() && label("sha256") != '"' + digest.digest() + '"')
        throw std::runtime_error(
            "it does not match its checksum: it is damaged, or, if edited on purpose, delete its line that starts with "
            "'# sha256:'");
    check(schedule);
    make_continuous(schedule.orientation);
    return schedule;
}

}  // namespace file

inline Schedule Schedule::load(const std::string& path) {
    std::ifstream stream(path, std::ios::binary);
    if (!stream) throw std::runtime_error(path + " cannot be opened.");
    try {
        return file::read(stream);
    } catch (const std::exception& error) {
        throw std::runtime_error(path + " cannot be read as a schedule: " + error.what() + ".");
    }
}

}  // namespace torch_pbd
