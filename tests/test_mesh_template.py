from lampopt.testing import decoder_checks
from lampopt_template.mesh_template import MeshTemplate
@decoder_checks(MeshTemplate.example())
def test_conforms(check):
    check()
