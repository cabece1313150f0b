// A voxel map, frame by frame: connected voxels of similar colour are one instance, named by shape.
//
//   g++ -std=c++17 -O2 -ffp-contract=off voxels.cpp -o voxels
#include "su3d_client.hpp"

#include <cmath>
#include <functional>

constexpr double SIZE_M = 0.05;
constexpr std::int64_t N_POINTS = 3;   // in a voxel, to be in the map
constexpr std::size_t N_VOXELS = 40;   // in an instance
constexpr std::int64_t DISTANCE = 16;  // largest difference of a colour channel between neighbours
constexpr std::int64_t OFFSET = 1 << 20, BITS = 21;  // a voxel's key is x, y, z + OFFSET, with BITS each

using Sums = std::array<std::int64_t, 4>;  // of a voxel: red, green, blue, number of points

struct Voxels : su3d::Mapper {
  std::map<std::int64_t, Sums> voxels;

  void frame(const su3d::Frame& frame) override {
    const auto& k = frame.intrinsics;
    const auto& pose = frame.camera_to_world;
    for (std::size_t pixel = 0; pixel < frame.depth_m.size(); ++pixel) {
      const double d = frame.depth_m[pixel];
      if (d == 0) continue;
      const double x = (double(pixel % frame.width) - k[2]) / k[0] * d;
      const double y = (double(pixel / frame.width) - k[5]) / k[4] * d;
      std::int64_t key = 0;
      for (int row = 0; row < 12; row += 4) {
        const double world = pose[row] * x + pose[row + 1] * y + pose[row + 2] * d + pose[row + 3];
        key = (key << BITS) + std::int64_t(std::floor(world / SIZE_M)) + OFFSET;
      }
      Sums& sums = voxels[key];
      for (int channel = 0; channel < 3; ++channel) sums[channel] += frame.rgb[3 * pixel + channel];
      ++sums[3];
    }
  }

  std::string snapshot(const std::string& folder) override {
    std::vector<std::int64_t> keys;  // ascending
    std::vector<Sums> colours;
    for (const auto& [key, sums] : voxels) {
      if (sums[3] < N_POINTS) continue;
      keys.push_back(key);
      colours.push_back({sums[0] / sums[3], sums[1] / sums[3], sums[2] / sums[3], 0});
    }
    std::vector<std::size_t> parent(keys.size());  // union-find; the root is the lowest voxel
    for (std::size_t i = 0; i < keys.size(); ++i) parent[i] = i;
    const std::function<std::size_t(std::size_t)> root = [&](std::size_t i) {
      while (parent[i] != i) i = parent[i] = parent[parent[i]];
      return i;
    };
    for (std::size_t i = 0; i < keys.size(); ++i)
      for (int axis = 0; axis < 3; ++axis) {
        const std::int64_t next = keys[i] + (std::int64_t(1) << (BITS * axis));
        const std::size_t j = std::lower_bound(keys.begin(), keys.end(), next) - keys.begin();
        if (j == keys.size() || keys[j] != next) continue;
        std::int64_t difference = 0;
        for (int channel = 0; channel < 3; ++channel)
          difference = std::max(difference, std::abs(colours[i][channel] - colours[j][channel]));
        if (difference > DISTANCE) continue;
        const std::size_t a = root(i), b = root(j);
        parent[std::max(a, b)] = std::min(a, b);
      }
    std::map<std::size_t, std::vector<std::size_t>> members;  // by root, ascending
    for (std::size_t i = 0; i < keys.size(); ++i) members[root(i)].push_back(i);

    std::vector<float> points;
    std::vector<std::array<std::int64_t, 3>> cells;
    for (const std::int64_t key : keys) {
      cells.emplace_back();
      for (int axis = 0; axis < 3; ++axis) {
        const std::int64_t cell = (key >> (BITS * (2 - axis)) & (2 * OFFSET - 1)) - OFFSET;
        cells.back()[axis] = cell;
        points.push_back(float((double(cell) + 0.5) * SIZE_M));
      }
    }
    std::vector<std::int32_t> instance(keys.size(), -1);
    std::vector<std::string> labels;
    for (const auto& [_, voxels_of] : members) {
      if (voxels_of.size() < N_VOXELS) continue;
      auto low = cells[voxels_of[0]], high = low;
      for (const std::size_t i : voxels_of) {
        instance[i] = std::int32_t(labels.size());
        for (int axis = 0; axis < 3; ++axis) {
          low[axis] = std::min(low[axis], cells[i][axis]);
          high[axis] = std::max(high[axis], cells[i][axis]);
        }
      }
      const auto extent_m = [&](int axis) { return double(high[axis] - low[axis] + 1) * SIZE_M; };
      const bool is_flat = extent_m(2) < 0.2 && std::min(extent_m(0), extent_m(1)) > 1;
      labels.push_back(extent_m(2) > 1.5 ? "wall" : is_flat ? "floor" : "cabinet");
    }
    su3d::write_instances(folder, points, instance, labels);
    return "";
  }

  void save(const std::string& folder) override {
    std::ofstream file(folder + "/voxels.txt");
    for (const auto& [key, sums] : voxels) {
      file << key;
      for (const std::int64_t sum : sums) file << ' ' << sum;
      file << '\n';
    }
  }

  void load(const std::string& folder) override {
    std::ifstream file(folder + "/voxels.txt");
    Sums sums;
    for (std::int64_t key; file >> key >> sums[0] >> sums[1] >> sums[2] >> sums[3];) voxels[key] = sums;
  }
};

int main() {
  Voxels voxels;
  return su3d::serve(voxels);
}
