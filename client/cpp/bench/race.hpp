// What the programs of client/cpp/race do; each prints one line of JSON. report.py starts them in turns.
#pragma once

// Grows one planner in this process: OMPL takes one seed.
int plan(int count, char **arguments);
// Neighbours of many points, GNAT and Wayfold in turns.
int many_neighbors(int count, char **arguments);
// Single inserts.
int inserts(int count, char **arguments);
// The searches of a file of rows, which client/c/examples/rows.rs makes in Rust.
int rows(int count, char **arguments);
