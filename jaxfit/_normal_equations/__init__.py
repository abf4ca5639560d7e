"""Normal matrices of least-squares fits as stencils on the net, thin plates, and their solvers."""

from jaxfit._normal_equations._coupled_preconditioner import CoupledPreconditioner as CoupledPreconditioner
from jaxfit._normal_equations._coupled_preconditioner import coupled_preconditioner as coupled_preconditioner
from jaxfit._normal_equations._coupled_preconditioner import solve_coupled as solve_coupled
from jaxfit._normal_equations._coupled_stencil import CoupledStencil as CoupledStencil
from jaxfit._normal_equations._coupled_stencil import coupled_stencil as coupled_stencil
from jaxfit._normal_equations._curvature_energy import curvature_density as curvature_density
from jaxfit._normal_equations._curvature_energy import curvature_energy as curvature_energy
from jaxfit._normal_equations._gmres import Operator as Operator
from jaxfit._normal_equations._gmres import gmres as gmres
from jaxfit._normal_equations._gmres import gmres_cycle as gmres_cycle
from jaxfit._normal_equations._normal_operator import BlockCholesky as BlockCholesky
from jaxfit._normal_equations._normal_operator import NormalOperator as NormalOperator
from jaxfit._normal_equations._normal_operator import normal_solver as normal_solver
from jaxfit._normal_equations._penalty import AbstractPenalty as AbstractPenalty
from jaxfit._normal_equations._penalty import WeightedPlate as WeightedPlate
from jaxfit._normal_equations._roughness import Roughness as Roughness
from jaxfit._normal_equations._stencil import Stencil as Stencil
from jaxfit._normal_equations._system import RegularisedSystem as RegularisedSystem
from jaxfit._normal_equations._system import free_points as free_points
from jaxfit._normal_equations._system import make_system as make_system
from jaxfit._normal_equations._tensor_preconditioned_cg import (
    TensorPreconditionedCG as TensorPreconditionedCG,
)
from jaxfit._normal_equations._thin_plate import ThinPlate as ThinPlate
from jaxfit._normal_equations._thin_plate import thin_plate as thin_plate
