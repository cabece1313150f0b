// Client for C++17 programs that su3d-bench feeds frame by frame (frame_by_frame = true); copy this file. No dependencies.
//
//   struct Mapper : su3d::Mapper {
//     void frame(const su3d::Frame& frame) override { ... }
//     std::string snapshot(const std::string& folder) override { ... write a prediction to the folder ... return ""; }
//   };
//   int main() { Mapper mapper; return su3d::serve(mapper); }
//
// The machine must be little-endian, as x86-64 and arm64 are.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iostream>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace su3d {

using Pose = std::array<double, 16>;          // 4x4, row by row: camera to world, metres
using Scene = std::map<std::string, std::string>;  // dataset, scene, image_domain, stride, seed, n_frames, mesh

struct Frame {
  std::int64_t number = 0;
  double time_s = 0;
  std::uint32_t width = 0, height = 0;
  std::array<double, 9> intrinsics{};  // 3x3, row by row, pixels
  Pose camera_to_world{};
  std::vector<float> depth_m;          // height x width, along the optical axis, 0 for none
  std::vector<std::uint8_t> rgb;       // height x width x 3
};

struct Refused : std::runtime_error {  // the program cannot do this; it continues
  using std::runtime_error::runtime_error;
};

// Exceptions other than Refused end the program and fail the scene.
struct Mapper {
  virtual ~Mapper() = default;
  virtual void start(const Scene&) {}
  virtual void frame(const Frame& frame) = 0;
  // Write a prediction to the folder; return the number of the last frame in it, or "" for the last one received.
  virtual std::string snapshot(const std::string& folder) = 0;
  virtual void revise(const std::map<std::int64_t, Pose>&) { throw Refused("it has no revise"); }
  virtual void save(const std::string&) { throw Refused("it has no save"); }
  virtual void load(const std::string&) { throw Refused("it has no load"); }
  virtual void finish() {}
};

namespace detail {

enum Kind : std::uint32_t { HELLO = 1, FRAME, SNAPSHOT, REVISE, SAVE, LOAD, FINISH, OK = 100, REFUSED, ERROR };
constexpr std::uint64_t MAX_REQUEST_BYTES = 1ull << 30;

struct Header {  // 24 bytes
  char magic[4];
  std::uint32_t kind;
  std::uint64_t number, n_bytes;
};
static_assert(sizeof(Header) == 24, "a header has 24 bytes");

inline void read_exactly(std::FILE* pipe, void* data, std::size_t n_bytes) {
  if (n_bytes != 0 && std::fread(data, 1, n_bytes, pipe) != n_bytes)
    throw std::runtime_error("su3d-bench has closed the pipe");
}

inline void answer(std::FILE* pipe, std::uint64_t number, Kind kind, std::string text) {
  text.resize(std::min<std::size_t>(text.size(), 4096));
  const Header header{{'S', 'U', '3', 'D'}, kind, number, text.size()};
  std::fwrite(&header, sizeof header, 1, pipe);
  std::fwrite(text.data(), 1, text.size(), pipe);
  std::fflush(pipe);
}

class Parts {  // reads values from a request one after another
 public:
  explicit Parts(const std::vector<char>& data) : data_(data) {}
  bool is_at_end() const { return place_ == data_.size(); }
  void copy(void* target, std::size_t n_bytes) {
    if (n_bytes > data_.size() - place_) throw std::runtime_error("a request is too short");
    if (n_bytes != 0) std::memcpy(target, data_.data() + place_, n_bytes);
    place_ += n_bytes;
  }
  template <class Value> Value next() {
    Value value;
    copy(&value, sizeof value);
    return value;
  }
  template <class Value> void fill(std::vector<Value>& values, std::uint64_t n) {
    if (n > data_.size() / sizeof(Value)) throw std::runtime_error("a request is too short");
    values.resize(n);
    copy(values.data(), n * sizeof(Value));
  }

 private:
  const std::vector<char>& data_;
  std::size_t place_ = 0;
};

// The text of the answer, after the call that a request stands for; the memory of frame is used again.
inline std::string done(Mapper& mapper, std::uint32_t kind, const std::vector<char>& content, Frame& frame) {
  Parts parts(content);
  if (kind == FRAME) {
    frame.number = parts.next<std::int64_t>();
    frame.time_s = parts.next<double>();
    frame.width = parts.next<std::uint32_t>();
    frame.height = parts.next<std::uint32_t>();
    frame.intrinsics = parts.next<std::array<double, 9>>();
    frame.camera_to_world = parts.next<Pose>();
    const std::uint64_t n = std::uint64_t(frame.width) * frame.height;
    parts.fill(frame.depth_m, n);
    parts.fill(frame.rgb, 3 * n);
    mapper.frame(frame);
    return "";
  }
  const std::string text(content.begin(), content.end());
  if (kind == HELLO) {
    Scene scene;
    std::istringstream lines(text);
    for (std::string line; std::getline(lines, line);)
      scene[line.substr(0, line.find(' '))] = line.substr(line.find(' ') + 1);
    mapper.start(scene);
    return "1";  // the version of the messages
  }
  if (kind == REVISE) {
    std::map<std::int64_t, Pose> poses;
    while (!parts.is_at_end()) {
      const auto number = parts.next<std::int64_t>();
      poses[number] = parts.next<Pose>();
    }
    mapper.revise(poses);
    return "";
  }
  if (kind == SNAPSHOT) return mapper.snapshot(text);
  if (kind == SAVE) return mapper.save(text), "";
  if (kind == LOAD) return mapper.load(text), "";
  if (kind == FINISH) return mapper.finish(), "";
  throw Refused("it has no answer to requests of kind " + std::to_string(kind));
}

}  // namespace detail

// Answer requests until the last one; the exit code for main().
inline int serve(Mapper& mapper) {
  using namespace detail;
  const char* pipes = std::getenv("SU3D_PIPES");
  std::FILE* requests = pipes ? std::fopen((std::string(pipes) + "/requests").c_str(), "rb") : nullptr;
  std::FILE* answers = pipes ? std::fopen((std::string(pipes) + "/answers").c_str(), "wb") : nullptr;
  if (!requests || !answers) {
    std::cerr << "no pipes in SU3D_PIPES: su3d-bench starts this program, with frame_by_frame = true\n";
    return 2;
  }
  Header header{};
  Frame frame;
  std::vector<char> content;
  while (header.kind != FINISH) {
    try {
      read_exactly(requests, &header, sizeof header);
      if (std::memcmp(header.magic, "SU3D", 4) != 0 || header.n_bytes > MAX_REQUEST_BYTES)
        throw std::runtime_error("not a request of su3d-bench");
      content.resize(header.n_bytes);
      read_exactly(requests, content.data(), content.size());
      answer(answers, header.number, OK, done(mapper, header.kind, content, frame));
    } catch (const Refused& refusal) {
      answer(answers, header.number, REFUSED, refusal.what());
    } catch (const std::exception& error) {
      answer(answers, header.number, ERROR, error.what());
      std::cerr << error.what() << "\n";
      return 1;
    }
  }
  return 0;
}

namespace detail {

template <class Number> void put(std::string& bytes, Number number) {
  bytes.append(reinterpret_cast<const char*>(&number), sizeof number);
}

inline std::uint32_t crc32(const std::string& bytes) {
  std::uint32_t crc = ~0u;
  for (const unsigned char byte : bytes) {
    crc ^= byte;
    for (int bit = 0; bit < 8; ++bit) crc = (crc >> 1) ^ (crc & 1 ? 0xEDB88320u : 0u);
  }
  return ~crc;
}

// An array in NumPy's format: descr such as "<f4", shape such as "5, 3".
inline std::string npy(const std::string& descr, const std::string& shape, const void* data, std::size_t n_bytes) {
  std::string header = "{'descr': '" + descr + "', 'fortran_order': False, 'shape': (" + shape + "), }";
  header.append(63 - (10 + header.size()) % 64, ' ').push_back('\n');
  std::string bytes("\x93NUMPY\x01\x00", 8);
  put(bytes, std::uint16_t(header.size()));
  bytes += header;
  return n_bytes == 0 ? bytes : bytes.append(static_cast<const char*>(data), n_bytes);
}

// A zip archive without compression, of less than 4 GiB.
inline std::string zip(const std::vector<std::pair<std::string, std::string>>& files) {
  std::string bytes, directory;
  for (const auto& [name, content] : files) {
    std::string entry;  // version, flags, method, time, date, checksum, sizes, lengths of name and extra field
    for (const int value : {20, 0, 0, 0, 33}) put(entry, std::uint16_t(value));
    put(entry, crc32(content));
    for (int size = 0; size < 2; ++size) put(entry, std::uint32_t(content.size()));
    put(entry, std::uint16_t(name.size()));
    put(entry, std::uint16_t(0));
    const std::uint32_t place = std::uint32_t(bytes.size());
    bytes += std::string("PK\x03\x04") + entry + name + content;
    directory += std::string("PK\x01\x02\x14\x00", 6) + entry + std::string(10, '\0');
    put(directory, place);
    directory += name;
  }
  const std::uint32_t place = std::uint32_t(bytes.size());
  bytes += directory + std::string("PK\x05\x06\x00\x00\x00\x00", 8);
  for (int disk = 0; disk < 2; ++disk) put(bytes, std::uint16_t(files.size()));
  put(bytes, std::uint32_t(directory.size()));
  put(bytes, place);
  return bytes + std::string(2, '\0');
}

}  // namespace detail

// Write prediction.npz, a map of instances: points (x, y, z of one after another, metres), the instance of each point, from
// 0 without gaps and -1 for none, and for each instance a class name in ASCII.
inline void write_instances(const std::string& folder, const std::vector<float>& points,
                            const std::vector<std::int32_t>& instance, const std::vector<std::string>& labels) {
  std::size_t width = 1;
  for (const std::string& label : labels) width = std::max(width, label.size());
  std::vector<std::uint32_t> letters(labels.size() * width);
  for (std::size_t k = 0; k < labels.size(); ++k)
    for (std::size_t i = 0; i < labels[k].size(); ++i) letters[k * width + i] = static_cast<unsigned char>(labels[k][i]);
  const std::vector<std::uint32_t> kind = {'I', 'n', 's', 't', 'a', 'n', 'c', 'e', 's'};
  using detail::npy;
  const std::string n = std::to_string(instance.size());
  std::ofstream file(folder + "/prediction.npz", std::ios::binary);
  file << detail::zip({
      {"kind.npy", npy("<U9", "", kind.data(), kind.size() * 4)},
      {"points.npy", npy("<f4", n + ", 3", points.data(), points.size() * 4)},
      {"instance.npy", npy("<i4", n + ",", instance.data(), instance.size() * 4)},
      {"labels.npy", npy("<U" + std::to_string(width), std::to_string(labels.size()) + ",", letters.data(), letters.size() * 4)},
  });
  if (!file.flush()) throw std::runtime_error("cannot write " + folder + "/prediction.npz");
}

}  // namespace su3d
