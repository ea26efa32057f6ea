/// The plain file of a schedule: labels in JSON, a table of numbers, a checksum of what they say.
#pragma once

#include <algorithm>
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

#include "sha256.hpp"

namespace torch_pbd {

namespace file {

/// Value of JSON with the entries of its objects in the order of their keys, as `json.dumps(..., sort_keys=True)`.
class SortedJson {
public:
    explicit SortedJson(std::string_view text) : text_(text) {}

    std::string whole() {
        std::string sorted = value(0);
        if (place_ != text_.size()) fail();
        return sorted;
    }

private:
    [[noreturn]] static void fail() { throw std::runtime_error("its labels are not JSON"); }

    std::string value(int depth) {
        if (place_ == text_.size() || depth > kDeepest) fail();
        const char first = text_[place_];
        if (first == '"') return string();
        if (first == '[' || first == '{') return members(depth, first == '{');
        const std::size_t end = std::min(text_.find_first_of(",]} ", place_), text_.size());
        const std::size_t start = std::exchange(place_, end);
        return std::string(text_.substr(start, end - start));
    }

    std::string string() {
        const std::size_t start = place_;
        while (++place_ < text_.size() && text_[place_] != '"') place_ += text_[place_] == '\\';
        if (place_ >= text_.size()) fail();
        return std::string(text_.substr(start, ++place_ - start));
    }

    std::string members(int depth, bool is_object) {
        const char close = is_object ? '}' : ']';
        std::vector<std::pair<std::u16string, std::string>> entries;
        ++place_;
        while (!take(close)) {
            if (!entries.empty() && !(take(',') && take(' '))) fail();
            const std::string key = is_object ? string() : "";
            if (is_object && !(take(':') && take(' '))) fail();
            entries.emplace_back(letters(key), (is_object ? key + ": " : "") + value(depth + 1));
        }
        if (is_object) std::sort(entries.begin(), entries.end());
        std::string joined(1, is_object ? '{' : '[');
        for (const auto& [key, entry] : entries) joined += (joined.size() > 1 ? ", " : "") + entry;
        return joined + close;
    }

    bool take(char wanted) {
        if (place_ >= text_.size() || text_[place_] != wanted) return false;
        ++place_;
        return true;
    }

    /// Letters of a key, which stands in ASCII with escapes, whose order is another one.
    static std::u16string letters(std::string_view key) {
        constexpr std::string_view escapes = "nrtbf", meant = "\n\r\t\b\f";
        std::u16string decoded;
        for (std::size_t i = 1; i + 1 < key.size(); ++i) {
            char16_t letter = static_cast<unsigned char>(key[i]);
            if (letter == u'\\') {
                const char escape = key[++i];
                const std::size_t known = escapes.find(escape);
                letter = static_cast<unsigned char>(known < escapes.size() ? meant[known] : escape);
                if (escape == 'u') {
                    letter = static_cast<char16_t>(std::stoul(std::string(key.substr(i + 1, 4)), nullptr, 16));
                    i += 4;
                }
            }
            decoded += letter;
        }
        return decoded;
    }

    static constexpr int kDeepest = 200;
    std::string_view text_;
    std::size_t place_ = 0;
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

/// The table of a file as arrays: columns of one array stand side by side, of matrices their upper triangles.
class Table {
public:
    /// Titles are `time`, `position[x]`, `stiffness[x][y]`.
    explicit Table(const std::vector<std::string>& titles) : n_columns_(titles.size()) {
        for (const std::string& title : titles) {
            const std::string name = title.substr(0, title.find('['));
            if (arrays_.empty() || arrays_.back().name != name) arrays_.push_back({name, {}, {}});
            const bool is_indexed = name.size() < title.size() && title.back() == ']';
            arrays_.back().places.push_back(is_indexed ? title.substr(name.size() + 1, title.size() - name.size() - 2)
                                                       : "");
        }
    }

    void add(std::string_view line, std::size_t number_of_line) {
        std::size_t column = 0;
        for (Array& array : arrays_) {
            for (std::size_t i = 0; i < array.places.size(); ++i, ++column) {
                const std::size_t end = std::min(line.find(','), line.size());
                if ((end == line.size()) != (column + 1 == n_columns_))
                    throw std::runtime_error("line " + std::to_string(number_of_line) +
                                             " has not as many cells as the " + std::to_string(n_columns_) +
                                             " columns");
                array.values.push_back(number(line.substr(0, end), number_of_line));
                line.remove_prefix(std::min(end + 1, line.size()));
            }
        }
        ++n_rows;
    }

    /// Places of the columns of an array: names of outputs; none where it is absent.
    std::vector<std::string> places(const std::string& name) {
        const auto array = find(name);
        return array == arrays_.end() ? std::vector<std::string>() : array->places;
    }
    bool has(const std::string& name) { return !places(name).empty(); }
    bool is_empty() const { return arrays_.empty(); }

    /// Removes an array whose columns have these places, and returns its values.
    std::vector<double> take(const std::string& name, const std::vector<std::string>& places_expected) {
        if (places(name) != places_expected)
            throw std::runtime_error("its columns of " + name + " are not " + std::to_string(places_expected.size()) +
                                     " in the order of the outputs");
        const auto array = find(name);
        std::vector<double> values = std::move(array->values);
        arrays_.erase(array);
        return values;
    }

    /// Removes an array of upper triangles, and returns the whole symmetric matrices (n, d, d).
    std::vector<double> take_matrices(const std::string& name, const std::vector<std::string>& outputs) {
        // Files once had titles with commas, stiffness[x,y].
        std::vector<std::string> triangle, triangle_once;
        const std::size_t d = outputs.size();
        for (std::size_t i = 0; i < d; ++i) {
            for (std::size_t j = i; j < d; ++j) {
                triangle.push_back(outputs[i] + "][" + outputs[j]);
                triangle_once.push_back(outputs[i] + "," + outputs[j]);
            }
        }
        const std::vector<double> upper = take(name, places(name) == triangle_once ? triangle_once : triangle);
        std::vector<double> whole(n_rows * d * d);
        std::size_t next = 0;
        for (std::size_t row = 0; row < n_rows; ++row)
            for (std::size_t i = 0; i < d; ++i)
                for (std::size_t j = i; j < d; ++j)
                    whole[(row * d + i) * d + j] = whole[(row * d + j) * d + i] = upper[next++];
        return whole;
    }

    std::size_t n_rows = 0;

private:
    struct Array {
        std::string name;
        std::vector<std::string> places;
        std::vector<double> values;
    };

    std::vector<Array>::iterator find(const std::string& name) {
        return std::find_if(arrays_.begin(), arrays_.end(), [&](const Array& array) { return array.name == name; });
    }

    std::size_t n_columns_;
    std::vector<Array> arrays_;
};

/// SHA-256 of what a file says, not of how it is written: line ends and spelling of numbers are free.
class Digest {
public:
    explicit Digest(const std::map<std::string, std::string>& labels) {
        std::string header;
        for (const auto& [key, value] : labels)
            if (key != "sha256") header += (header.empty() ? "{\"" : ", \"") + key + "\": " + SortedJson(value).whole();
        sha256_.update(header + "}");
    }

    /// Adds an array of a shape, such as "100, 2".
    void add(const std::string& name, const std::string& shape, const std::vector<double>& values) {
        sha256_.update(name + " (" + shape + ") ");
        for (const double value : values) {
            std::uint64_t bits;
            std::memcpy(&bits, &value, sizeof bits);
            char bytes[8];
            for (int i = 0; i < 8; ++i) bytes[i] = static_cast<char>(bits >> (8 * i));
            sha256_.update({bytes, 8});
        }
    }

    std::string text() { return sha256_.digest(); }

private:
    Sha256 sha256_;
};

}  // namespace file
}  // namespace torch_pbd
