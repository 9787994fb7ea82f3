/* A program on Cyclone DDS that has EPypes' messages, without EPypes.

   peer echo DOMAIN TOPIC    sends each message of TOPIC back on TOPIC_back
   peer odd DOMAIN TOPIC     sends messages that EPypes never does, and a good one, to TOPIC */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "dds/dds.h"
#include "message.h"

static dds_entity_t checked(dds_entity_t result, const char *what) {
  if (result < 0) {
    fprintf(stderr, "%s: %s\n", what, dds_strretcode(-result));
    exit(1);
  }
  return result;
}

static void echo(dds_entity_t participant, dds_entity_t reader, dds_entity_t writer) {
  dds_entity_t waitset = checked(dds_create_waitset(participant), "waitset");
  dds_entity_t any = checked(dds_create_readcondition(reader, DDS_ANY_STATE), "condition");
  checked(dds_waitset_attach(waitset, any, 0), "attach");
  for (;;) {
    void *messages[1] = {NULL};
    dds_sample_info_t info[1];
    checked(dds_waitset_wait(waitset, NULL, 0, DDS_INFINITY), "wait");
    int count = checked(dds_take(reader, messages, info, 1, 1), "take");
    if (count > 0 && info[0].valid_data) checked(dds_write(writer, messages[0]), "write");
    if (count > 0) dds_return_loan(reader, messages, count);
  }
}

static void odd(dds_entity_t writer) {
  uint8_t content[] = {1, 2, 3};
  epypes_v1_Frame frames[3];
  memset(frames, 0, sizeof frames);
  for (int i = 0; i < 3; i++) frames[i].data = (dds_sequence_octet){3, 3, content, false};
  epypes_v1_Message message;
  memset(&message, 0, sizeof message);
  message.id = "not \xff UTF-8";
  message.frames._buffer = frames;
  message.frames._length = 1;
  checked(dds_write(writer, &message), "an id");
  message.id = "no frames";
  message.frames._length = 0;
  checked(dds_write(writer, &message), "no frames");
  message.id = "no envelope";
  message.frames._length = 3;
  checked(dds_write(writer, &message), "no envelope");
  message.id = "good";
  message.frames._length = 1;
  checked(dds_write(writer, &message), "good");
  dds_sleepfor(DDS_SECS(600));
}

int main(int count, char **words) {
  if (count != 4) return 2;
  char back[256];
  snprintf(back, sizeof back, "%s_back", words[3]);
  int is_echo = strcmp(words[1], "echo") == 0;
  dds_entity_t participant = checked(dds_create_participant((dds_domainid_t)atoi(words[2]), NULL, NULL), "participant");
  dds_qos_t *qos = dds_create_qos();
  dds_qset_reliability(qos, DDS_RELIABILITY_RELIABLE, DDS_SECS(10));
  dds_qset_durability(qos, is_echo ? DDS_DURABILITY_VOLATILE : DDS_DURABILITY_TRANSIENT_LOCAL);
  dds_qset_durability_service(qos, 0, DDS_HISTORY_KEEP_LAST, 10, -1, -1, -1);
  dds_qset_history(qos, DDS_HISTORY_KEEP_LAST, 10);
  const char *to = is_echo ? back : words[3];
  dds_entity_t out = checked(dds_create_topic(participant, &epypes_v1_Message_desc, to, NULL, NULL), "topic");
  dds_entity_t writer = checked(dds_create_writer(participant, out, qos, NULL), "writer");
  if (!is_echo) odd(writer);
  dds_entity_t in = checked(dds_create_topic(participant, &epypes_v1_Message_desc, words[3], NULL, NULL), "topic");
  echo(participant, checked(dds_create_reader(participant, in, qos, NULL), "reader"), writer);
}
