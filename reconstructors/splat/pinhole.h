// The camera of the splats, included before maths.h: the same for every instruction set and device. It includes
// nothing.
#pragma once

struct Pinhole {
    float rotation[9];  // cam_from_world, row-major
    float position[3];  // of the camera in the world
    float fx, fy, cx, cy;
    float left, right, top, bottom;  // bounds to which x / z and y / z are clamped for the affine approximation
    float nearest;                   // depth up to which nothing is drawn
    int width, height;
};
