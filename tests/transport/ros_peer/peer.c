/* A publisher or a subscriber of sensor_msgs/Image on Cyclone DDS, as a node of ROS 2 is one, without EPypes.

   peer KIND DOMAIN TOPIC RELIABILITY DURABILITY DEPTH [FIRST COUNT PERIOD_MS]

   KIND "view" writes what it receives to its standard output: a line with the fields of an image, then its pixels.
   "bytes" writes the bytes in which DDS sends one image, and ends. The others publish COUNT images from number FIRST on: "image" as they are, "lies" with a height that its pixels do not
   have, "cut" bytes of another type under the name of sensor_msgs/Image, "string" std_msgs/String. They write a line
   when there is a subscriber, which a volatile publisher waits for, and one for each message. All run until they are
   killed. */

#include <inttypes.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "dds/dds.h"
#include "dds/ddsi/ddsi_serdata.h"
#include "messages.h"

enum { WIDTH = 640, HEIGHT = 480, STEP = 3 * WIDTH, SIZE = HEIGHT * STEP };

static dds_entity_t checked(dds_entity_t result, const char *what) {
  if (result < 0) {
    fprintf(stderr, "%s: %s\n", what, dds_strretcode(-result));
    exit(1);
  }
  return result;
}

static void report(const char *what, int number) {
  printf("%s %d\n", what, number);
  fflush(stdout);
}

static dds_qos_t *quality(char *const *words) {
  dds_qos_t *qos = dds_create_qos();
  bool is_reliable = strcmp(words[0], "reliable") == 0, is_volatile = strcmp(words[1], "volatile") == 0;
  int depth = atoi(words[2]);
  dds_qset_reliability(qos, is_reliable ? DDS_RELIABILITY_RELIABLE : DDS_RELIABILITY_BEST_EFFORT, DDS_SECS(1));
  dds_qset_durability(qos, is_volatile ? DDS_DURABILITY_VOLATILE : DDS_DURABILITY_TRANSIENT_LOCAL);
  dds_qset_history(qos, DDS_HISTORY_KEEP_LAST, depth);
  dds_qset_durability_service(qos, 0, DDS_HISTORY_KEEP_LAST, depth, -1, -1, -1);
  return qos;
}

static void wait_for_subscriber(dds_entity_t writer) {
  dds_publication_matched_status_t status = {0};
  while (status.current_count == 0) {
    dds_sleepfor(DDS_MSECS(5));
    checked(dds_get_publication_matched_status(writer, &status), "matched");
  }
  report("matched", (int)status.current_count);
}

static void write_image(dds_entity_t writer, int number, uint32_t height) {
  static uint8_t pixels[SIZE];
  for (uint32_t at = 0; at < SIZE; at++) pixels[at] = (uint8_t)(number * 7919 + at * 31 + (at >> 8));
  sensor_msgs_msg_dds__Image_ image = {
      .header = {.stamp = {.sec = number, .nanosec = 500}, .frame_id = "camera"},
      .height = height,
      .width = WIDTH,
      .encoding = "bgr8",
      .step = STEP,
      .data = {._length = SIZE, ._maximum = SIZE, ._buffer = pixels},
  };
  checked(dds_write(writer, &image), "write");
}

static void publish(dds_entity_t writer, const char *kind, int first, int count, int period_ms) {
  for (int number = first; number < first + count; number++) {
    if (strcmp(kind, "image") == 0) {
      write_image(writer, number, HEIGHT);
    } else if (strcmp(kind, "lies") == 0) {
      write_image(writer, number, HEIGHT + 1);
    } else {
      std_msgs_msg_dds__String_ text = {.data = "no image"};
      checked(dds_write(writer, &text), "write");
    }
    report("published", number);
    dds_sleepfor(DDS_MSECS(period_ms));
  }
}

static void show_bytes(dds_entity_t writer, dds_entity_t reader) {
  static uint8_t bytes[SIZE + 1024];
  struct ddsi_serdata *data;
  dds_sample_info_t info;
  write_image(writer, 7, HEIGHT);
  if (checked(dds_takecdr(reader, &data, 1, &info, DDS_ANY_STATE), "take") != 1) exit(1);
  uint32_t size = ddsi_serdata_size(data);
  if (size > sizeof(bytes)) exit(1);
  ddsi_serdata_to_ser(data, 0, size, bytes);
  fwrite(bytes, 1, size, stdout);
}

static void view(dds_entity_t participant, dds_entity_t reader) {
  dds_entity_t waitset = checked(dds_create_waitset(participant), "waitset");
  checked(dds_set_status_mask(reader, DDS_DATA_AVAILABLE_STATUS), "status");
  checked(dds_waitset_attach(waitset, reader, 0), "attach");
  report("waiting", 0);
  for (;;) {
    void *samples[1] = {NULL};
    dds_sample_info_t info;
    checked(dds_waitset_wait(waitset, NULL, 0, DDS_INFINITY), "wait");
    while (checked(dds_take(reader, samples, &info, 1, 1), "take") > 0) {
      if (info.valid_data) {
        const sensor_msgs_msg_dds__Image_ *image = samples[0];
        printf("image %" PRId32 " %" PRIu32 " %s %" PRIu32 " %" PRIu32 " %s %d %" PRIu32 " %" PRIu32 "\n",
               image->header.stamp.sec, image->header.stamp.nanosec, image->header.frame_id, image->height, image->width,
               image->encoding, image->is_bigendian, image->step, image->data._length);
        fwrite(image->data._buffer, 1, image->data._length, stdout);
        fflush(stdout);
      }
      checked(dds_return_loan(reader, samples, 1), "return");
    }
  }
}

int main(int count, char **words) {
  if (count < 7) return 2;
  const char *kind = words[1];
  bool is_text = strcmp(kind, "cut") == 0 || strcmp(kind, "string") == 0;
  dds_topic_descriptor_t type = is_text ? std_msgs_msg_dds__String__desc : sensor_msgs_msg_dds__Image__desc;
  if (strcmp(kind, "cut") == 0) type.m_typename = sensor_msgs_msg_dds__Image__desc.m_typename;
  dds_entity_t participant = checked(dds_create_participant((dds_domainid_t)atoi(words[2]), NULL, NULL), "participant");
  dds_entity_t topic = checked(dds_create_topic(participant, &type, words[3], NULL, NULL), "topic");
  dds_qos_t *qos = quality(words + 4);
  dds_entity_t reader = 0, writer = 0;
  if (strcmp(kind, "view") == 0 || strcmp(kind, "bytes") == 0) {
    reader = checked(dds_create_reader(participant, topic, qos, NULL), "reader");
  }
  if (strcmp(kind, "view") != 0) writer = checked(dds_create_writer(participant, topic, qos, NULL), "writer");
  if (strcmp(kind, "view") == 0) {
    view(participant, reader);
  } else if (strcmp(kind, "bytes") == 0) {
    show_bytes(writer, reader);
  } else {
    if (strcmp(words[5], "volatile") == 0) wait_for_subscriber(writer);
    publish(writer, kind, atoi(words[7]), atoi(words[8]), atoi(words[9]));
    dds_sleepfor(DDS_INFINITY);
  }
  return 0;
}
