/*
 * One frame from C: a model, a rig and an image per camera to a digest of the classes.
 *
 *     cargo rustc --release --lib --no-default-features --features capi --crate-type cdylib
 *     cc -std=c11 -Iinclude examples/infer.c -Ltarget/release -lvoxcast -o infer
 *     LD_LIBRARY_PATH=target/release ./infer model.safetensors rig.safetensors front.ppm ...
 *
 * Images are binary PPM (P6, 8 bits, no comments), one for each of the rig's cameras in their order.
 */

#include "voxcast.h"

#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

/* Reads a PPM file. The caller frees the pixels; they are NULL where it fails. */
static voxcast_image read_image(const char *path)
{
    voxcast_image image = { .order = VOXCAST_RGB };
    char after = 0;
    FILE *file = fopen(path, "rb");
    if (!file)
        return image;
    if (fscanf(file, "P6 %5zu %5zu 255%c", &image.width, &image.height, &after) == 3) {
        image.length = image.width * image.height * 3;
        uint8_t *pixels = malloc(image.length ? image.length : 1);
        if (pixels && fread(pixels, 1, image.length, file) != image.length) {
            free(pixels);
            pixels = NULL;
        }
        image.pixels = pixels;
    }
    fclose(file);
    return image;
}

int main(int argc, char **argv)
{
    if (argc < 4) {
        fprintf(stderr, "usage: infer MODEL RIG IMAGE.ppm...\n");
        return 2;
    }
    if (voxcast_abi() != VOXCAST_ABI) {
        fprintf(stderr, "libvoxcast %s is not the one of this program's voxcast.h\n", voxcast_version());
        return 1;
    }
    const size_t cameras = (size_t)argc - 3;
    const voxcast_options options = { .size = sizeof options, .threads = 2 };
    voxcast_network network = { .size = sizeof network };
    voxcast_model *model = NULL;
    voxcast_rig *rig = NULL;
    voxcast_session *session = NULL;
    uint8_t *classes = NULL;
    char message[VOXCAST_MESSAGE] = "";
    int exit_code = 1;
    uint64_t bytes, digest;

    voxcast_image *images = calloc(cameras, sizeof *images);
    for (size_t camera = 0; images && camera < cameras; camera++) {
        images[camera] = read_image(argv[3 + camera]);
        if (!images[camera].pixels) {
            snprintf(message, sizeof message, "%s: cannot read, expected a binary PPM of 8 bits", argv[3 + camera]);
            goto end;
        }
    }

    /* Once. From the session on, nothing is allocated. */
    if (voxcast_model_open(argv[1], &model, message, sizeof message) != VOXCAST_OK
        || voxcast_model_network(model, &network, message, sizeof message) != VOXCAST_OK
        || voxcast_rig_open(model, argv[2], cameras, &rig, message, sizeof message) != VOXCAST_OK
        || voxcast_session_memory(model, cameras, &options, &bytes, message, sizeof message) != VOXCAST_OK
        || voxcast_session_new(model, rig, &options, &session, message, sizeof message) != VOXCAST_OK)
        goto end;
    classes = malloc(network.voxels);
    if (!images || !classes) {
        snprintf(message, sizeof message, "out of memory");
        goto end;
    }

    /* Every frame. classes[(x * Y + y) * Z + z] is the class of voxel (x, y, z); 0 is empty. */
    if (voxcast_session_run(session, images, cameras, message, sizeof message) != VOXCAST_OK
        || voxcast_session_classes(session, classes, network.voxels, NULL, message, sizeof message) != VOXCAST_OK
        || voxcast_session_digest(session, &digest, message, sizeof message) != VOXCAST_OK)
        goto end;

    size_t occupied = 0;
    for (size_t voxel = 0; voxel < network.voxels; voxel++)
        occupied += classes[voxel] != 0;
    printf("%zux%zux%zu voxels, %zu occupied, digest %016" PRIx64 ", session of %" PRIu64 " bytes\n",
        network.grid[0], network.grid[1], network.grid[2], occupied, digest, bytes);
    exit_code = 0;

end:
    if (exit_code)
        fprintf(stderr, "%s\n", message);
    free(classes);
    voxcast_session_free(session);
    voxcast_rig_free(rig);
    voxcast_model_free(model);
    for (size_t camera = 0; images && camera < cameras; camera++)
        free((void *)images[camera].pixels);
    free(images);
    return exit_code;
}
