// The contests of client/cpp/race. Each contest prints one line of JSON, and report.py runs them in turns.
#pragma once

// Grows one planner in this process: OMPL takes one seed.
int plan(int count, char **arguments);
// Neighbours of many points, GNAT and Wayfold in turns.
int many_neighbors(int count, char **arguments);
// Single inserts.
int inserts(int count, char **arguments);
// The searches of a file of rows, which client/c/examples/rows.rs makes in Rust.
int rows(int count, char **arguments);
