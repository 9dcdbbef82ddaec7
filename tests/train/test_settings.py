import pytest

from mocapfix.errors import SceneError
from mocapfix.files.shipped import find_shipped_folder
from mocapfix.train import settings

PCA = 'model: linear\ntitle: mine\ntest: ["02"]\nunseen: ["03"]\ncomponents: 3\n'


def test_what_ships_can_be_trained():
    for name in ("autoencoder", "gaussian", "mixture", "mnn-ik", "pca"):
        said = settings.read_prior_settings(find_shipped_folder("priors") / f"{name}.yaml")
        assert not said.test_subjects & said.held_out_subjects
    said = settings.read_twist_settings(find_shipped_folder("priors") / "twist.yaml")
    assert said.test_subjects == settings.read_prior_settings(find_shipped_folder("priors") / "autoencoder.yaml").test_subjects
    assert not said.test_subjects & said.held_out_subjects


def test_a_prior_is_not_trained_by_the_settings_of_the_twists_nor_they_by_its():
    with pytest.raises(SceneError, match=r"twist\.yaml: model: .*'twist'"):
        settings.read_prior_settings(find_shipped_folder("priors") / "twist.yaml")
    with pytest.raises(SceneError, match=r"pca\.yaml: model: .*'twist'"):
        settings.read_twist_settings(find_shipped_folder("priors") / "pca.yaml")


def test_the_papers_network_is_as_the_paper_says_but_for_what_its_settings_explain():
    said = settings.read_prior_settings(find_shipped_folder("priors") / "mnn-ik.yaml")
    assert isinstance(said, settings.AutoencoderSettings)
    assert (said.input_features, said.hidden_widths, said.code_size, said.activation) == ("euler", (1024, 1024, 1024), 35, "relu")
    assert (said.learning_rate, said.rate_schedule, said.corrupted_share) == (1e-4, 0.98, False)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("components: 3", "components: 0", "components"),
        ("components: 3", "components: 3\nlayers: 4", "layers"),
        ('test: ["02"]', "tests: []", "test"),
        ("model: linear", "model: forest", "model"),
        ("model: linear", "", "model"),
    ],
)
def test_settings_that_do_not_say_what_they_must_are_told_by_file_and_key(tmp_path, old, new, message):
    (tmp_path / "mine.yaml").write_text(PCA.replace(old, new))
    with pytest.raises(SceneError, match=rf"mine\.yaml: .*{message}"):
        settings.read_prior_settings(tmp_path / "mine.yaml")
