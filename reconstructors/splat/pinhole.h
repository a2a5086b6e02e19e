// The camera of the splats, read before maths.h: the same for every instruction set and device. It includes nothing.
#pragma once

struct Pinhole {
    float rotation[9];  // cam_from_world, by rows
    float position[3];  // in the world
    float fx, fy, cx, cy;
    float left, right, top, bottom;  // x / z and y / z at which the affine approximation is taken are held within these
    float nearest;                   // depth
    int width, height;
};
