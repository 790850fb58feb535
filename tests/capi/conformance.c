/*
 * What voxcast.h promises beyond examples/infer.c, statement by statement: misuse, sizes, steps, masks, rigs, threads,
 * and that frames allocate nothing. Linked with --wrap for the functions that allocate, so that they can be counted.
 *
 *     conformance MODEL RIG IMAGES HEIGHT WIDTH MATRICES FAULTY MUTE
 *
 * IMAGES holds two blue-first images, MATRICES two 4x4 matrices of f32, both raw. FAULTY is the model with a self-test
 * that cannot pass, MUTE the model without one. Prints the digests of classes and logits.
 */

#include "voxcast.h"

#include <inttypes.h>
#include <pthread.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { CAMERAS = 2, CLASSES = 5 };

static atomic_int failures, allocations;
static char message[VOXCAST_MESSAGE];

#define CHECK(condition)                                                                                             \
    do {                                                                                                             \
        if (!(condition)) {                                                                                          \
            failures++;                                                                                              \
            fprintf(stderr, "%s:%d: not so: %s (message: %s)\n", __FILE__, __LINE__, #condition, message);           \
        }                                                                                                            \
    } while (0)

/* That a call returns a status, with a message if and only if that is a failure. */
#define RETURNS(expected, call)                                                                                      \
    do {                                                                                                             \
        memset(message, '?', sizeof message);                                                                        \
        const voxcast_status found = (call);                                                                         \
        message[sizeof message - 1] = 0;                                                                             \
        if (found != (expected) || (message[0] == 0) != (found == VOXCAST_OK)) {                                     \
            failures++;                                                                                              \
            fprintf(stderr, "%s:%d: %s, not %s, with \"%s\": %s\n", __FILE__, __LINE__,                              \
                voxcast_status_name(found), #expected, message, #call);                                              \
        }                                                                                                            \
    } while (0)

#define SAID message, sizeof message

void *__real_malloc(size_t size);
void *__real_calloc(size_t count, size_t size);
void *__real_realloc(void *old, size_t size);
int __real_posix_memalign(void **place, size_t alignment, size_t size);
void *__wrap_malloc(size_t size);
void *__wrap_calloc(size_t count, size_t size);
void *__wrap_realloc(void *old, size_t size);
int __wrap_posix_memalign(void **place, size_t alignment, size_t size);

void *__wrap_malloc(size_t size)
{
    allocations++;
    return __real_malloc(size);
}

void *__wrap_calloc(size_t count, size_t size)
{
    allocations++;
    return __real_calloc(count, size);
}

void *__wrap_realloc(void *old, size_t size)
{
    allocations++;
    return __real_realloc(old, size);
}

int __wrap_posix_memalign(void **place, size_t alignment, size_t size)
{
    allocations++;
    return __real_posix_memalign(place, alignment, size);
}

/* The arguments, and what was made of them. */
static const char *model_path, *rig_path, *faulty_path, *mute_path;
/* Bytes of a session with default options, of one with logits, and of one with confidence, as the library says in Rust. */
static uint64_t memory_of_classes, memory_with_logits, memory_with_confidence;
static voxcast_image images[CAMERAS];
static float matrices[CAMERAS * 16];
static voxcast_model *model;
static voxcast_network network = { .size = sizeof network };

/* A file's bytes, which the caller frees. */
static uint8_t *read_file(const char *path, size_t *length)
{
    FILE *file = fopen(path, "rb");
    if (!file || fseek(file, 0, SEEK_END))
        exit(3);
    *length = (size_t)ftell(file);
    rewind(file);
    uint8_t *bytes = malloc(*length + 1);
    if (!bytes || fread(bytes, 1, *length, file) != *length)
        exit(3);
    fclose(file);
    return bytes;
}

static void the_library(void)
{
    CHECK(voxcast_abi() == VOXCAST_ABI);
    CHECK(strchr(voxcast_version(), '.') != NULL);
    CHECK(!strcmp(voxcast_status_name(VOXCAST_MISMATCH), "VOXCAST_MISMATCH"));
    CHECK(!strcmp(voxcast_status_name(-1), "unknown") && !strcmp(voxcast_status_name(1000), "unknown"));
    voxcast_model_free(NULL);
    voxcast_rig_free(NULL);
    voxcast_rig_builder_free(NULL);
    voxcast_session_free(NULL);
    CHECK(voxcast_rig_builder_steps(NULL) == 0);
}

static void messages(void)
{
    char room[64];
    voxcast_model *none = (voxcast_model *)room;
    CHECK(voxcast_model_open("/no/such/file", &none, NULL, 0) == VOXCAST_IO && none == NULL);
    CHECK(voxcast_model_open("/no/such/file", &none, NULL, 99) == VOXCAST_IO);
    for (size_t capacity = 0; capacity < sizeof room; capacity++) {
        memset(room, '#', sizeof room);
        /* Of characters of two bytes, half of the capacities would cut one. */
        CHECK(voxcast_model_open("/\303\244\303\244\303\244\303\244", &none, room, capacity) == VOXCAST_IO);
        size_t written = 0;
        while (written < sizeof room && room[written] != '#')
            written++;
        CHECK(written <= capacity && (capacity == 0 || (written > 0 && room[written - 1] == 0)));
        CHECK(written < 2 || ((unsigned char)room[written - 2] & 0xc0) != 0xc0);
    }
}

static void models(void)
{
    voxcast_model *other = NULL;
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_model_open(NULL, &other, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_model_open(model_path, NULL, SAID));
    RETURNS(VOXCAST_IO, voxcast_model_open("/no/such/file", &other, SAID));
    CHECK(strstr(message, "/no/such/file"));
    RETURNS(VOXCAST_FORMAT, voxcast_model_open(rig_path, &other, SAID));
    RETURNS(VOXCAST_OK, voxcast_model_open(model_path, &model, SAID));

    size_t length;
    uint8_t *bytes = read_file(model_path, &length);
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_model_from_bytes(NULL, 8, &other, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_model_from_bytes(bytes + 1, length - 1, &other, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_model_from_bytes(bytes, SIZE_MAX, &other, SAID));
    RETURNS(VOXCAST_FORMAT, voxcast_model_from_bytes(bytes, length - 1, &other, SAID));
    RETURNS(VOXCAST_FORMAT, voxcast_model_from_bytes(bytes, 0, &other, SAID));
    CHECK(other == NULL);
    RETURNS(VOXCAST_OK, voxcast_model_from_bytes(bytes, length, &other, SAID));
    voxcast_network same = { .size = sizeof same };
    RETURNS(VOXCAST_OK, voxcast_model_network(other, &same, SAID));
    voxcast_model_free(other);
    free(bytes);

    RETURNS(VOXCAST_OK, voxcast_model_network(model, &network, SAID));
    CHECK(!memcmp(&same, &network, sizeof same));
    CHECK(network.cameras == CAMERAS && network.classes == CLASSES && network.checksum != 0);
    CHECK(network.voxels == network.grid[0] * network.grid[1] * network.grid[2] && network.grid[0] != network.grid[1]);
    CHECK(network.bounds[0][0] == -50 && network.bounds[1][1] == 40 && network.bounds[2][1] == 3);
    CHECK((images[0].height + 31) / 32 * 32 == network.height && (images[0].width + 31) / 32 * 32 == network.width);
}

static void self_tests(void)
{
    voxcast_model *other;
    const voxcast_options options = { .size = sizeof options, .isa = "scalar", .threads = 2 };
    RETURNS(VOXCAST_OK, voxcast_model_selftest(model, NULL, SAID));
    RETURNS(VOXCAST_OK, voxcast_model_selftest(model, &options, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_model_selftest(NULL, NULL, SAID));
    RETURNS(VOXCAST_OK, voxcast_model_open(faulty_path, &other, SAID));
    RETURNS(VOXCAST_SELFTEST_FAILED, voxcast_model_selftest(other, NULL, SAID));
    CHECK(strstr(message, "operation classes"));
    voxcast_model_free(other);
    RETURNS(VOXCAST_OK, voxcast_model_open(mute_path, &other, SAID));
    RETURNS(VOXCAST_UNSUPPORTED, voxcast_model_selftest(other, NULL, SAID));
    voxcast_model_free(other);
}

static void structs_of_other_sizes(void)
{
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_model_network(model, NULL, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_model_network(NULL, &network, SAID));
    const size_t wrong[] = { 0, 1, sizeof(size_t), sizeof(voxcast_network) - 1, 4097, SIZE_MAX };
    for (size_t i = 0; i < sizeof wrong / sizeof *wrong; i++) {
        voxcast_network sized = { .size = wrong[i] };
        RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_model_network(model, &sized, SAID));
        CHECK(sized.voxels == 0 && sized.size == wrong[i]);
    }
    struct {
        voxcast_network known;
        uint64_t later;
    } wide = { .known = { .size = sizeof wide }, .later = 5 };
    RETURNS(VOXCAST_OK, voxcast_model_network(model, &wide.known, SAID));
    CHECK(wide.known.voxels == network.voxels && wide.known.size == sizeof wide && wide.later == 0);

    uint64_t bytes;
    struct {
        voxcast_options known;
        uint64_t later;
    } options = { .known = { .size = sizeof options } };
    RETURNS(VOXCAST_OK, voxcast_session_memory(model, CAMERAS, &options.known, &bytes, SAID));
    options.later = 1;
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_memory(model, CAMERAS, &options.known, &bytes, SAID));
    for (size_t i = 0; i < sizeof wrong / sizeof *wrong; i++) {
        /* The first version ended where confidence begins. */
        options.known.size = wrong[i] == sizeof(voxcast_network) - 1 ? offsetof(voxcast_options, confidence) - 1 : wrong[i];
        RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_memory(model, CAMERAS, &options.known, &bytes, SAID));
    }
}

static void options_that_cannot_be(const voxcast_rig *rig)
{
    voxcast_session *session = (voxcast_session *)message;
    voxcast_rig_builder *builder;
    voxcast_options options = { .size = sizeof options, .isa = "AVX2" };
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_new(model, rig, &options, &session, SAID));
    CHECK(session == NULL);
    options.isa = "\377";
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_new(model, rig, &options, &session, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_rig_builder_new(model, CAMERAS, &options, &builder, SAID));
    options = (voxcast_options) { .size = sizeof options, .threads = 1025 };
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_new(model, rig, &options, &session, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_new(NULL, rig, NULL, &session, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_new(model, NULL, NULL, &session, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_new(model, rig, NULL, NULL, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_memory(model, CAMERAS, NULL, NULL, SAID));
    uint64_t bytes;
    RETURNS(VOXCAST_OK, voxcast_session_memory(model, CAMERAS, NULL, &bytes, SAID));
    CHECK(bytes == memory_of_classes);
    options = (voxcast_options) { .size = sizeof options, .logits = 1 };
    RETURNS(VOXCAST_OK, voxcast_session_memory(model, CAMERAS, &options, &bytes, SAID));
    CHECK(bytes == memory_with_logits);
    options = (voxcast_options) { .size = sizeof options, .confidence = 1 };
    RETURNS(VOXCAST_OK, voxcast_session_memory(model, CAMERAS, &options, &bytes, SAID));
    /* Two results, of two bytes more for each voxel. */
    CHECK(bytes == memory_with_confidence && bytes > memory_of_classes + 4 * network.voxels);
    options.reserved = 1;
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_memory(model, CAMERAS, &options, &bytes, SAID));
    options.reserved = 0;
    /* A program that was compiled when the struct was shorter. */
    options.size = offsetof(voxcast_options, confidence);
    RETURNS(VOXCAST_OK, voxcast_session_memory(model, CAMERAS, &options, &bytes, SAID));
    CHECK(bytes == memory_of_classes);
    RETURNS(VOXCAST_TOO_LARGE, voxcast_session_memory(model, SIZE_MAX / 2, &options, &bytes, SAID));
}

static void images_that_cannot_be(voxcast_session *session)
{
    voxcast_image bad[] = { images[0], images[0], images[0], images[0], images[0], images[0], images[0] };
    bad[0].pixels = NULL;
    bad[1].order = 2;
    bad[2].reserved = 1;
    bad[3].length--;
    bad[4].height += 32;
    bad[5].stride = 3 * bad[5].width - 1;
    bad[6].length = SIZE_MAX;
    for (size_t i = 0; i < sizeof bad / sizeof *bad; i++) {
        const voxcast_status expected = i < 3 || i == 6 ? VOXCAST_INVALID_ARGUMENT : VOXCAST_MISMATCH;
        RETURNS(expected, voxcast_session_set_camera(session, 0, &bad[i], SAID));
        const voxcast_image frame[CAMERAS] = { images[0], bad[i] };
        RETURNS(expected, voxcast_session_run(session, frame, CAMERAS, SAID));
    }
    RETURNS(VOXCAST_MISMATCH, voxcast_session_set_camera(session, CAMERAS, images, SAID));
    RETURNS(VOXCAST_MISMATCH, voxcast_session_set_masked(session, CAMERAS, 1, SAID));
    RETURNS(VOXCAST_MISMATCH, voxcast_session_run(session, images, CAMERAS - 1, SAID));
    RETURNS(VOXCAST_MISMATCH, voxcast_session_run(session, NULL, 0, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_run(session, NULL, CAMERAS, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_run(session, images, SIZE_MAX, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_set_camera(session, 0, NULL, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_set_camera(NULL, 0, images, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_run(NULL, images, CAMERAS, SAID));
}

static void before_the_first_frame(voxcast_session *session)
{
    uint8_t byte = 7;
    size_t length = 0;
    uint64_t number;
    int32_t step;
    RETURNS(VOXCAST_OK, voxcast_session_classes(session, NULL, 0, &length, SAID));
    CHECK(length == network.voxels);
    RETURNS(VOXCAST_OK, voxcast_session_bits(session, NULL, 0, &length, SAID));
    CHECK(length == (network.voxels + 7) / 8);
    RETURNS(VOXCAST_OK, voxcast_session_support(session, NULL, 0, &length, SAID));
    CHECK(length == network.voxels);
    RETURNS(VOXCAST_OK, voxcast_session_logits(session, NULL, 0, &length, SAID));
    CHECK(length == network.voxels * network.classes);
    RETURNS(VOXCAST_OK, voxcast_session_confidence_occupied(session, NULL, 0, &length, SAID));
    CHECK(length == network.voxels);
    RETURNS(VOXCAST_BUFFER_TOO_SMALL, voxcast_session_confidence_class(session, &byte, 1, &length, SAID));
    CHECK(length == network.voxels && byte == 7);
    RETURNS(VOXCAST_OK, voxcast_session_cameras(session, NULL, 0, &length, SAID));
    CHECK(length == CAMERAS);
    voxcast_camera cameras[CAMERAS];
    RETURNS(VOXCAST_NO_RESULT, voxcast_session_cameras(session, cameras, CAMERAS, NULL, SAID));
    RETURNS(VOXCAST_NO_RESULT, voxcast_session_digest(session, &number, SAID));
    RETURNS(VOXCAST_NO_RESULT, voxcast_session_logits_digest(session, &number, SAID));
    RETURNS(VOXCAST_NO_RESULT, voxcast_session_longest_slice(session, &number, NULL, 0, SAID));
    RETURNS(VOXCAST_BUFFER_TOO_SMALL, voxcast_session_classes(session, &byte, 1, NULL, SAID));
    CHECK(byte == 7);
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_classes(session, NULL, 0, NULL, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_classes(NULL, &byte, 1, &length, SAID));
    RETURNS(VOXCAST_OK, voxcast_session_step(session, VOXCAST_SLICES, 1, &step, SAID));
    CHECK(step == VOXCAST_IDLE);
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_step(session, 3, 1, &step, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_step(session, VOXCAST_SLICES, 1, NULL, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_step(NULL, VOXCAST_SLICES, 1, &step, SAID));
}

static uint64_t digest_of(voxcast_session *session)
{
    uint64_t digest = 0;
    RETURNS(VOXCAST_OK, voxcast_session_digest(session, &digest, SAID));
    return digest;
}

/* Images of other layouts, and steps of every kind, give the digest of a whole frame. */
static void other_ways(voxcast_session *session, uint64_t expected)
{
    const size_t height = images[0].height, width = images[0].width, stride = 3 * width + 5;
    uint8_t *red = malloc(CAMERAS * height * stride);
    for (size_t i = 0; i < CAMERAS * height; i++)
        for (size_t j = 0; j < 3 * width; j++)
            red[i * stride + j] = images[i / height].pixels[i % height * 3 * width + j / 3 * 3 + 2 - j % 3];
    const size_t length = height * stride - 5;
    voxcast_image strided[CAMERAS];
    for (size_t camera = 0; camera < CAMERAS; camera++) {
        const uint8_t *first = red + camera * height * stride;
        strided[camera] = (voxcast_image) { first, length, height, width, stride, VOXCAST_RGB, 0 };
    }
    const struct {
        int32_t budget;
        uint64_t amount;
    } ways[] = { { VOXCAST_UNLIMITED, 0 }, { VOXCAST_SLICES, 0 }, { VOXCAST_SLICES, 7 }, { VOXCAST_SLICES, UINT64_MAX },
        { VOXCAST_NANOSECONDS, 0 }, { VOXCAST_NANOSECONDS, 100000 }, { VOXCAST_NANOSECONDS, UINT64_MAX } };
    for (size_t way = 0; way < sizeof ways / sizeof *ways; way++) {
        int32_t step = VOXCAST_RUNNING;
        /* Other images first, so that an old result cannot pass for the new one. */
        for (size_t camera = 0; camera < CAMERAS; camera++)
            RETURNS(VOXCAST_OK, voxcast_session_set_camera(session, camera, &images[0], SAID));
        RETURNS(VOXCAST_OK, voxcast_session_step(session, VOXCAST_UNLIMITED, 0, &step, SAID));
        CHECK(step == VOXCAST_COMPLETE && digest_of(session) != expected);
        for (size_t camera = CAMERAS; camera-- > 0;)
            RETURNS(VOXCAST_OK, voxcast_session_set_camera(session, camera, &strided[camera], SAID));
        do
            RETURNS(VOXCAST_OK, voxcast_session_step(session, ways[way].budget, ways[way].amount, &step, SAID));
        while (step == VOXCAST_RUNNING);
        CHECK(step == VOXCAST_COMPLETE && digest_of(session) == expected);
    }
    free(red);
    char name[6];
    uint64_t longest;
    RETURNS(VOXCAST_OK, voxcast_session_longest_slice(session, &longest, name, sizeof name, SAID));
    CHECK(longest > 0 && strlen(name) > 0);
    RETURNS(VOXCAST_OK, voxcast_session_longest_slice(session, &longest, NULL, 0, SAID));
}

/* Classes, logits, confidence, bits and support agree with each other. */
static void results(voxcast_session *session)
{
    const size_t voxels = network.voxels, count = voxels * network.classes;
    size_t length, occupied = 0, unseen = 0;
    uint8_t *classes = malloc(voxels), *bits = malloc(voxels), *sure = malloc(voxels), *filled = malloc(voxels);
    uint16_t *support = malloc(voxels * sizeof *support);
    float *logits = malloc(count * sizeof *logits);
    RETURNS(VOXCAST_OK, voxcast_session_classes(session, classes, voxels, &length, SAID));
    RETURNS(VOXCAST_OK, voxcast_session_logits(session, logits, count, &length, SAID));
    RETURNS(VOXCAST_OK, voxcast_session_support(session, support, voxels, &length, SAID));
    CHECK(length == voxels);
    RETURNS(VOXCAST_OK, voxcast_session_bits(session, bits, voxels, &length, SAID));
    RETURNS(VOXCAST_OK, voxcast_session_confidence_occupied(session, filled, voxels, &length, SAID));
    RETURNS(VOXCAST_OK, voxcast_session_confidence_class(session, sure, voxels, NULL, SAID));
    CHECK(length == voxels);
    for (size_t v = 0; v < voxels; v++) {
        size_t best = 0;
        for (size_t k = 1; k < network.classes; k++)
            if (logits[v * network.classes + k] > logits[v * network.classes + best])
                best = k;
        CHECK(classes[v] == best && (bits[v / 8] >> v % 8 & 1) == (best != 0));
        /* Of an empty voxel the two probabilities are all; else that of its class is a part of "occupied". */
        CHECK(best == 0 ? abs(sure[v] + filled[v] - 255) <= 1 : sure[v] <= filled[v] + 1);
        CHECK(sure[v] * network.classes >= 255 - network.classes);
        occupied += best != 0;
        unseen += support[v] == 0;
    }
    CHECK(occupied > 0 && unseen > 0 && unseen < voxels);
    RETURNS(VOXCAST_BUFFER_TOO_SMALL, voxcast_session_logits(session, logits, count - 1, &length, SAID));
    CHECK(length == count);
    RETURNS(VOXCAST_INVALID_ARGUMENT,
        voxcast_session_logits(session, (float *)(void *)(bits + 1), count, &length, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_session_classes(session, classes, SIZE_MAX, &length, SAID));
    free(classes);
    free(bits);
    free(sure);
    free(filled);
    free(support);
    free(logits);
}

static void masks(voxcast_session *session, uint64_t expected)
{
    voxcast_camera cameras[CAMERAS];
    int32_t step;
    RETURNS(VOXCAST_OK, voxcast_session_run(session, images, CAMERAS, SAID));
    RETURNS(VOXCAST_OK, voxcast_session_set_masked(session, 0, 1, SAID));
    RETURNS(VOXCAST_OK, voxcast_session_set_camera(session, 1, &images[1], SAID));
    RETURNS(VOXCAST_OK, voxcast_session_step(session, VOXCAST_UNLIMITED, 0, &step, SAID));
    RETURNS(VOXCAST_OK, voxcast_session_cameras(session, cameras, CAMERAS, NULL, SAID));
    CHECK(step == VOXCAST_COMPLETE && digest_of(session) != expected);
    CHECK(cameras[0].masked == 1 && cameras[0].age == 1 && cameras[0].reserved == 0);
    CHECK(cameras[1].masked == 0 && cameras[1].age == 0 && cameras[1].image == cameras[0].image + 1);
    RETURNS(VOXCAST_OK, voxcast_session_set_masked(session, 0, 0, SAID));
    RETURNS(VOXCAST_OK, voxcast_session_step(session, VOXCAST_UNLIMITED, 0, &step, SAID));
    CHECK(step == VOXCAST_COMPLETE && digest_of(session) == expected);
}

static void rigs(voxcast_session *session, voxcast_rig *first, uint64_t expected)
{
    voxcast_rig *rig = NULL, *spare = NULL;
    voxcast_rig_builder *builder;
    uint32_t complete;
    RETURNS(VOXCAST_MISMATCH, voxcast_rig_open(model, rig_path, CAMERAS + 1, &rig, SAID));
    RETURNS(VOXCAST_MISMATCH, voxcast_rig_open(model, model_path, CAMERAS, &rig, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_rig_open(NULL, rig_path, CAMERAS, &rig, SAID));
    RETURNS(VOXCAST_FORMAT, voxcast_rig_builder_new(model, 0, NULL, &builder, SAID));
    const voxcast_options options = { .size = sizeof options, .threads = 2 };
    RETURNS(VOXCAST_OK, voxcast_rig_builder_new(model, CAMERAS, &options, &builder, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_rig_builder_build(builder, NULL, CAMERAS, &rig, SAID));
    RETURNS(VOXCAST_MISMATCH, voxcast_rig_builder_build(builder, matrices, CAMERAS - 1, &rig, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_rig_builder_build(builder, matrices, SIZE_MAX, &rig, SAID));
    float turned[CAMERAS * 16];
    memcpy(turned, matrices + 16, sizeof turned / 2);
    memcpy(turned + 16, matrices, sizeof turned / 2);
    uint32_t known = 7;
    RETURNS(VOXCAST_OK, voxcast_rig_check(first, matrices, CAMERAS, &known, SAID));
    CHECK(known == 1);
    RETURNS(VOXCAST_MISMATCH, voxcast_rig_check(first, turned, CAMERAS, &known, SAID));
    CHECK(known == 0 && strstr(message, "another order"));
    RETURNS(VOXCAST_MISMATCH, voxcast_rig_check(first, matrices, CAMERAS - 1, &known, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_rig_check(first, NULL, CAMERAS, &known, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_rig_check(NULL, matrices, CAMERAS, &known, SAID));
    RETURNS(VOXCAST_INVALID_ARGUMENT, voxcast_rig_check(first, matrices, CAMERAS, NULL, SAID));
    RETURNS(VOXCAST_OK, voxcast_rig_builder_build(builder, turned, CAMERAS, &spare, SAID));
    RETURNS(VOXCAST_MISMATCH, voxcast_rig_builder_advance(builder, 1, spare, &complete, SAID));

    RETURNS(VOXCAST_OK, voxcast_session_run(session, images, CAMERAS, SAID));
    int32_t step;
    RETURNS(VOXCAST_OK, voxcast_session_swap_rig(session, spare, SAID));
    RETURNS(VOXCAST_OK, voxcast_session_step(session, VOXCAST_UNLIMITED, 0, &step, SAID));
    CHECK(step == VOXCAST_COMPLETE && digest_of(session) != expected);
    /* `spare` and `first` now share the matrices of the file. */
    RETURNS(VOXCAST_OK, voxcast_rig_builder_begin(builder, matrices, CAMERAS, SAID));
    RETURNS(VOXCAST_BUSY, voxcast_rig_builder_advance(builder, 1, spare, &complete, SAID));
    voxcast_rig_free(first);
    const size_t steps = voxcast_rig_builder_steps(builder);
    for (size_t i = 1; i <= steps; i++) {
        RETURNS(VOXCAST_OK, voxcast_rig_builder_advance(builder, 1, spare, &complete, SAID));
        CHECK(complete == (i == steps));
    }
    RETURNS(VOXCAST_OK, voxcast_session_swap_rig(session, spare, SAID));
    RETURNS(VOXCAST_OK, voxcast_session_step(session, VOXCAST_UNLIMITED, 0, &step, SAID));
    CHECK(step == VOXCAST_COMPLETE && digest_of(session) == expected);
    voxcast_rig_free(spare);
    voxcast_rig_builder_free(builder);
}

static void frames_allocate_nothing(voxcast_session *session)
{
    uint8_t *classes = malloc(network.voxels);
    voxcast_camera cameras[CAMERAS];
    int32_t step;
    const int before = allocations;
    CHECK(before > 0);
    for (int frame = 0; frame < 3; frame++) {
        RETURNS(VOXCAST_OK, voxcast_session_run(session, images, CAMERAS, SAID));
        RETURNS(VOXCAST_OK, voxcast_session_set_masked(session, 0, frame == 1, SAID));
        RETURNS(VOXCAST_OK, voxcast_session_set_camera(session, 1, images, SAID));
        do
            RETURNS(VOXCAST_OK, voxcast_session_step(session, VOXCAST_SLICES, 50, &step, SAID));
        while (step == VOXCAST_RUNNING);
        RETURNS(VOXCAST_OK, voxcast_session_classes(session, classes, network.voxels, NULL, SAID));
        RETURNS(VOXCAST_OK, voxcast_session_bits(session, classes, network.voxels, NULL, SAID));
        RETURNS(VOXCAST_OK, voxcast_session_cameras(session, cameras, CAMERAS, NULL, SAID));
        digest_of(session);
    }
    CHECK(allocations == before);
    free(classes);
}

/* Uses a session as long as it takes, together with others: each call is done, or finds another inside. */
static void *use(void *session)
{
    for (int i = 0; i < 200; i++) {
        int32_t step;
        voxcast_status status = voxcast_session_set_camera(session, (size_t)i % CAMERAS, &images[i % CAMERAS], NULL, 0);
        if (status == VOXCAST_OK || status == VOXCAST_BUSY)
            status = voxcast_session_step(session, VOXCAST_SLICES, 3, &step, NULL, 0);
        if (status != VOXCAST_OK && status != VOXCAST_BUSY)
            failures++;
    }
    return NULL;
}

static void several_threads(voxcast_session *session, uint64_t expected)
{
    pthread_t threads[3];
    for (size_t i = 0; i < 3; i++) {
        CHECK(pthread_create(&threads[i], NULL, use, session) == 0);
        /* The first in turn, the others at once. */
        if (i == 0)
            CHECK(pthread_join(threads[0], NULL) == 0);
    }
    CHECK(pthread_join(threads[1], NULL) == 0 && pthread_join(threads[2], NULL) == 0);
    RETURNS(VOXCAST_OK, voxcast_session_run(session, images, CAMERAS, SAID));
    CHECK(digest_of(session) == expected);
}

int main(int argc, char **argv)
{
    if (argc != 12)
        return 2;
    model_path = argv[1];
    rig_path = argv[2];
    faulty_path = argv[7];
    mute_path = argv[8];
    memory_of_classes = strtoull(argv[9], NULL, 10);
    memory_with_logits = strtoull(argv[10], NULL, 10);
    memory_with_confidence = strtoull(argv[11], NULL, 10);
    size_t length;
    uint8_t *pixels = read_file(argv[3], &length), *bytes;
    const size_t height = strtoul(argv[4], NULL, 10), width = strtoul(argv[5], NULL, 10), image = 3 * height * width;
    if (length != CAMERAS * image)
        return 3;
    for (size_t camera = 0; camera < CAMERAS; camera++)
        images[camera] = (voxcast_image) { pixels + camera * image, image, height, width, 0, VOXCAST_BGR, 0 };
    bytes = read_file(argv[6], &length);
    if (length != sizeof matrices)
        return 3;
    memcpy(matrices, bytes, sizeof matrices);
    free(bytes);

    the_library();
    messages();
    models();
    self_tests();
    structs_of_other_sizes();
    voxcast_rig *rig;
    RETURNS(VOXCAST_OK, voxcast_rig_open(model, rig_path, CAMERAS, &rig, SAID));
    options_that_cannot_be(rig);
    const voxcast_options options = {
        .size = sizeof options, .threads = 2, .logits = 1, .slice_cost = 300000, .confidence = 1,
    };
    voxcast_session *session, *plain;
    RETURNS(VOXCAST_OK, voxcast_session_new(model, rig, &options, &session, SAID));
    const voxcast_options scalar = { .size = sizeof scalar, .isa = "scalar" };
    RETURNS(VOXCAST_OK, voxcast_session_new(model, rig, &scalar, &plain, SAID));
    RETURNS(VOXCAST_UNSUPPORTED, voxcast_session_logits(plain, NULL, 0, &length, SAID));
    RETURNS(VOXCAST_UNSUPPORTED, voxcast_session_confidence_occupied(plain, NULL, 0, &length, SAID));
    RETURNS(VOXCAST_UNSUPPORTED, voxcast_session_confidence_class(plain, NULL, 0, &length, SAID));
    RETURNS(VOXCAST_OK, voxcast_session_run(plain, images, CAMERAS, SAID));
    const uint64_t specified = digest_of(plain);
    uint64_t of_logits;
    RETURNS(VOXCAST_UNSUPPORTED, voxcast_session_logits_digest(plain, &of_logits, SAID));
    voxcast_session_free(plain);
    images_that_cannot_be(session);
    before_the_first_frame(session);
    RETURNS(VOXCAST_OK, voxcast_session_run(session, images, CAMERAS, SAID));
    const uint64_t digest = digest_of(session);
    CHECK(digest == specified);
    RETURNS(VOXCAST_OK, voxcast_session_logits_digest(session, &of_logits, SAID));
    results(session);
    other_ways(session, digest);
    masks(session, digest);
    rigs(session, rig, digest);
    frames_allocate_nothing(session);
    /* The session keeps what it uses. */
    voxcast_model_free(model);
    several_threads(session, digest);
    voxcast_session_free(session);
    free(pixels);
    printf("digest %016" PRIx64 ", of logits %016" PRIx64 "\n", digest, of_logits);
    return failures != 0;
}
