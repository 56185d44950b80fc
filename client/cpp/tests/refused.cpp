// ompl.hpp: `use` compiles for the planner of the macro PLANNER, or the compiler says the sentence. With ALLOCATED,
// `allocator` compiles for it too. client/cpp/check compiles this file.
#include <ompl/control/planners/rrt/RRT.h>
#include <ompl/control/planners/sst/SST.h>
#include <ompl/control/planners/syclop/SyclopRRT.h>
#include <ompl/geometric/planners/fmt/FMT.h>
#include <ompl/geometric/planners/informedtrees/ABITstar.h>
#include <ompl/geometric/planners/informedtrees/BITstar.h>
#include <ompl/geometric/planners/prm/SPARStwo.h>
#include <ompl/geometric/planners/rrt/LBTRRT.h>
#include <ompl/geometric/planners/rrt/LazyLBTRRT.h>
#include <ompl/geometric/planners/rrt/RRT.h>
#include <ompl/geometric/planners/rrt/TSRRT.h>
#include <ompl/tools/thunder/SPARSdb.h>
#include <wayfold/ompl.hpp>

void refused(PLANNER &planner) {
    wayfold::use(planner);
    wayfold::use(planner, "R1", [](const ompl::base::State *, double *) {});
}

#ifdef ALLOCATED
ompl::base::PlannerAllocator allocators[] = {
    wayfold::allocator<PLANNER>(), wayfold::allocator<PLANNER>("R1", [](const ompl::base::State *, double *) {})};
#endif
