from sierra.containers.images.podman_images import complaint

LOAD = """\
Getting image source signatures
Error: payload does not match any of the supported image formats:
 * oci: initializing source oci:a.tar:: open a.tar/index.json: not a directory
 * oci-archive: loading index: open /var/tmp/oci35/index.json: no such file or directory
 * docker-archive: writing blob: adding layer with blob "sha256:f4": lchown /etc/gshadow: invalid argument
 * dir: open a.tar/manifest.json: not a directory
"""


def test_the_reason_why_an_archive_cannot_be_loaded_is_that_of_its_format() -> None:
    assert complaint(LOAD) == 'writing blob: adding layer with blob "sha256:f4": lchown /etc/gshadow: invalid argument'
    assert complaint("Error: no such image\n") == "no such image"
