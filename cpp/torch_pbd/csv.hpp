/// The plain file of a schedule: labels in JSON, a table of numbers, a checksum of what they say.
#pragma once

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <locale>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace torch_pbd {
namespace file {

/// SHA-256 (FIPS 180-4) of bytes that come piece by piece.
class Sha256 {
public:
    void update(std::string_view bytes) {
        for (const char byte : bytes) push(static_cast<std::uint8_t>(byte));
    }

    void update(const std::vector<double>& values) {
        for (const double value : values) {
            std::uint64_t bits;
            std::memcpy(&bits, &value, sizeof bits);
            for (int i = 0; i < 8; ++i) push(static_cast<std::uint8_t>(bits >> (8 * i)));
        }
    }

    /// Digest as 64 hexadecimal digits; nothing may follow.
    std::string digest() {
        const std::uint64_t bits = 8 * n_bytes_;
        push(0x80);
        while (n_bytes_ % 64 != 56) push(0);
        for (int shift = 56; shift >= 0; shift -= 8) push(static_cast<std::uint8_t>(bits >> shift));
        std::string text;
        for (const std::uint32_t word : state_)
            for (int shift = 28; shift >= 0; shift -= 4) text += "0123456789abcdef"[(word >> shift) & 15];
        return text;
    }

private:
    void push(std::uint8_t byte) {
        const std::size_t place = n_bytes_++ % 64;
        words_[place / 4] = words_[place / 4] << 8 | byte;
        if (place == 63) compress();
    }

    void compress() {
        std::array<std::uint32_t, 64> w;
        for (std::size_t i = 0; i < 16; ++i) w[i] = words_[i];
        for (std::size_t i = 16; i < 64; ++i)
            w[i] = w[i - 16] + (turned(w[i - 15], 7) ^ turned(w[i - 15], 18) ^ w[i - 15] >> 3) + w[i - 7] +
                   (turned(w[i - 2], 17) ^ turned(w[i - 2], 19) ^ w[i - 2] >> 10);
        auto [a, b, c, d, e, f, g, h] = state_;
        for (std::size_t i = 0; i < 64; ++i) {
            const std::uint32_t first =
                h + (turned(e, 6) ^ turned(e, 11) ^ turned(e, 25)) + ((e & f) ^ (~e & g)) + kRounds[i] + w[i];
            const std::uint32_t second = (turned(a, 2) ^ turned(a, 13) ^ turned(a, 22)) + ((a & b) ^ (a & c) ^ (b & c));
            h = g, g = f, f = e, e = d + first, d = c, c = b, b = a, a = first + second;
        }
        const std::array<std::uint32_t, 8> added{a, b, c, d, e, f, g, h};
        for (std::size_t i = 0; i < 8; ++i) state_[i] += added[i];
    }

    static std::uint32_t turned(std::uint32_t word, int bits) { return word >> bits | word << (32 - bits); }

    static constexpr std::array<std::uint32_t, 64> kRounds{
        0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
        0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
        0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
        0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
        0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
        0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
        0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
        0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};
    std::array<std::uint32_t, 8> state_{0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                                        0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
    std::array<std::uint32_t, 16> words_{};
    std::uint64_t n_bytes_ = 0;
};

/// Number of a cell; the decimal point is a point in every locale.
inline double number(std::string_view cell, std::size_t line) {
    double value = 0.0;
#ifdef __cpp_lib_to_chars
    const auto [end, error] = std::from_chars(cell.data(), cell.data() + cell.size(), value);
    const bool is_good = error == std::errc() && end == cell.data() + cell.size();
#else
    std::istringstream stream{std::string(cell)};
    stream.imbue(std::locale::classic());
    const bool is_good = !(stream >> value).fail() && stream.peek() == std::istringstream::traits_type::eof();
#endif
    if (is_good && std::isfinite(value)) return value;
    throw std::runtime_error("line " + std::to_string(line) + ": '" + std::string(cell) + "' is not a finite number");
}

/// Cells of a line; titles with commas are quoted, and quotes in them doubled.
inline std::vector<std::string> cells(std::string_view line) {
    std::vector<std::string> found(1);
    bool is_quoted = false;
    for (const char letter : line) {
        if (letter == '"')
            is_quoted = !is_quoted;
        else if (letter == ',' && !is_quoted)
            found.emplace_back();
        else
            found.back() += letter;
    }
    return found;
}

/// The table of a file, whose arrays are taken one after another; of matrices it has the upper triangles.
class Table {
public:
    explicit Table(std::string_view titles) : titles_(cells(titles)) {}

    void add(std::string_view line, std::size_t number_of_line) {
        for (std::size_t column = 0; column < titles_.size(); ++column) {
            const std::size_t end = std::min(line.find(','), line.size());
            if ((end == line.size()) != (column + 1 == titles_.size()))
                throw std::runtime_error("line " + std::to_string(number_of_line) + " has not as many cells as the " +
                                         std::to_string(titles_.size()) + " columns");
            values_.push_back(number(line.substr(0, end), number_of_line));
            line.remove_prefix(std::min(end + 1, line.size()));
        }
        ++n_rows;
    }

    /// Names in the titles of an array, such as x of position[x].
    std::vector<std::string> places(const std::string& name) const {
        std::vector<std::string> found;
        const std::size_t start = name.size() + 1;
        for (const std::string& title : titles_)
            if (title.substr(0, start) == name + "[") found.push_back(title.substr(start, title.size() - start - 1));
        return found;
    }

    /// Values of the next array, whose columns have these titles.
    std::vector<double> take(const std::string& name, const std::vector<std::string>& titles) {
        const auto first = titles_.begin() + static_cast<std::ptrdiff_t>(next_);
        const std::size_t n = titles_.size(), k = titles.size();
        if (next_ + k > n || !std::equal(titles.begin(), titles.end(), first))
            throw std::runtime_error("its columns of " + name + " are not " + std::to_string(k) +
                                     " in the order of the outputs");
        std::vector<double> values;
        for (std::size_t row = 0; row < n_rows; ++row)
            for (std::size_t column = next_; column < next_ + k; ++column) values.push_back(values_[row * n + column]);
        next_ += k;
        return values;
    }

    /// Values of the next array: whole symmetric matrices (n, d, d).
    std::vector<double> take_matrices(const std::string& name, const std::vector<std::string>& outputs) {
        const std::size_t d = outputs.size();
        std::vector<std::string> titles;
        for (std::size_t i = 0; i < d; ++i)
            for (std::size_t j = i; j < d; ++j)
                titles.push_back(name + "[" + outputs[i] + "][" + outputs[j] + "]");
        const std::vector<double> upper = take(name, titles);
        std::vector<double> whole(n_rows * d * d);
        std::size_t next = 0;
        for (std::size_t row = 0; row < n_rows; ++row)
            for (std::size_t i = 0; i < d; ++i)
                for (std::size_t j = i; j < d; ++j)
                    whole[(row * d + i) * d + j] = whole[(row * d + j) * d + i] = upper[next++];
        return whole;
    }

    bool is_taken() const { return next_ == titles_.size(); }

    std::size_t n_rows = 0;

private:
    std::vector<std::string> titles_;
    std::vector<double> values_;
    std::size_t next_ = 0;
};

/// JSON of the labels, which the checksum of a file begins with: but for itself, in the order of their keys.
inline std::string header_of(const std::map<std::string, std::string>& labels) {
    std::string header;
    for (const auto& [key, value] : labels)
        if (key != "sha256") header += (header.empty() ? "{\"" : ", \"") + key + "\": " + value;
    return header + "}";
}

}  // namespace file
}  // namespace torch_pbd
