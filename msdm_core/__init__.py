"""msdm_core: a tetrahedral mass-spring-damper organ (Sala et al. 2011) in numba, without MuJoCo and Gymnasium."""
