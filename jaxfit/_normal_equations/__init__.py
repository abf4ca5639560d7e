"""Normal matrices of least-squares fits as stencils on the net, thin plates, and their solvers."""

from jaxfit._normal_equations._coupled import CoupledStencil as CoupledStencil
from jaxfit._normal_equations._coupled import coupled_stencil as coupled_stencil
from jaxfit._normal_equations._coupled_solver import coupled_cg as coupled_cg
from jaxfit._normal_equations._coupled_solver import preconditioner as preconditioner
from jaxfit._normal_equations._curvature_energy import curvature_energy as curvature_energy
from jaxfit._normal_equations._operator import BlockCholesky as BlockCholesky
from jaxfit._normal_equations._operator import NormalOperator as NormalOperator
from jaxfit._normal_equations._operator import normal_solver as normal_solver
from jaxfit._normal_equations._stencil import Stencil as Stencil
from jaxfit._normal_equations._system import System as System
from jaxfit._normal_equations._system import free_points as free_points
from jaxfit._normal_equations._system import make_system as make_system
from jaxfit._normal_equations._tensor_cg import TensorCG as TensorCG
from jaxfit._normal_equations._thin_plate import ThinPlate as ThinPlate
from jaxfit._normal_equations._thin_plate import thin_plate as thin_plate
