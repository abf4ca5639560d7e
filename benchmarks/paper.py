"""Tables 1 to 5, Figures 1, 2, 4b, 7, 8 and 10 and the local mode of Kineri, Wang, Lin and Maekawa (2012).

The inputs stand in the roles of the paper's models, which are not public: compare ratios, not seconds.
The paper's times are of a Core i7-2600, one thread, in 2011.
"""

from benchmarks import paper_clouds, paper_grids

PARTS = {
    "tables123": paper_grids.tables,
    "figure1": paper_grids.figure_1,
    "figure2": paper_grids.figure_2,
    "table4": paper_clouds.table_4,
    "table5": paper_clouds.table_5,
    "figure4b": paper_clouds.figure_4b,
    "figure7": paper_grids.figure_7,
    "figures8and10": paper_clouds.figures_8_and_10,
    "local": paper_clouds.local_mode,
}
