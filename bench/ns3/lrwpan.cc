// The outside judge of IEEE 802.15.4: frames that are handed to ns-3.44 LrWpanNetDevices at given times, and what becomes of each.
//
//   lrwpan --positions=nodes.csv --offers=frames.csv --out=frames.bin [--exponent=3 --loss0=40.052 --sensitivity=-85 --seed=1]
//
// nodes.csv: x,y,z in m, one node a line. frames.csv: time in ns, sender, receiver (-1: all), payload in bytes, one frame a line.
// frames.bin: rows of int64: sender, receiver, offered, start of the last attempt, end (success, or given up), attempts, status,
// then for each node when it received the frame; times in ns, -1: never. Status: 0 sent, 1 no channel access, 2 no
// acknowledgement, -1 not decided at the end. Printed: CPU seconds and events of the run.
#include "ns3/core-module.h"
#include "ns3/lr-wpan-module.h"
#include "ns3/mobility-module.h"
#include "ns3/network-module.h"
#include "ns3/propagation-module.h"
#include "ns3/spectrum-module.h"

#include <cstdio>
#include <ctime>
#include <deque>
#include <fstream>
#include <map>
#include <string>
#include <vector>

using namespace ns3;
using namespace ns3::lrwpan;

namespace
{
struct Frame
{
    int64_t sender, to, offered, start = -1, end = -1, attempts = 0, status = -1;
    uint32_t size;
    std::vector<int64_t> received;
};

std::vector<Frame> g_frames;
std::map<uint64_t, size_t> g_frameOf;             // packet uid -> frame
std::vector<std::deque<size_t>> g_queued;         // by node: frames that are not decided
std::vector<Ptr<LrWpanNetDevice>> g_devices;

int64_t
Now()
{
    return Simulator::Now().GetNanoSeconds();
}

void
Offer(size_t index)
{
    Frame& frame = g_frames[index];
    Ptr<Packet> packet = Create<Packet>(frame.size);
    g_frameOf[packet->GetUid()] = index;
    g_queued[frame.sender].push_back(index);
    McpsDataRequestParams params;
    params.m_srcAddrMode = SHORT_ADDR;
    params.m_dstAddrMode = SHORT_ADDR;
    params.m_dstPanId = 1;
    params.m_dstAddr = frame.to < 0 ? Mac16Address("ff:ff") : g_devices[frame.to]->GetMac()->GetShortAddress();
    params.m_msduHandle = 0;
    params.m_txOptions = frame.to < 0 ? 0 : TX_OPTION_ACK;
    g_devices[frame.sender]->GetMac()->McpsDataRequest(params, packet);
}

void
TxBegin(Ptr<const Packet> packet)
{
    auto found = g_frameOf.find(packet->GetUid());
    if (found != g_frameOf.end())
    {
        g_frames[found->second].start = Now();
        g_frames[found->second].attempts++;
    }
}

void
Confirm(int64_t node, McpsDataConfirmParams params)
{
    Frame& frame = g_frames[g_queued[node].front()];
    g_queued[node].pop_front();
    frame.end = Now();
    frame.status = params.m_status == MacStatus::SUCCESS                  ? 0
                   : params.m_status == MacStatus::CHANNEL_ACCESS_FAILURE ? 1
                                                                          : 2;
}

void
Indication(int64_t node, McpsDataIndicationParams, Ptr<Packet> packet)
{
    auto& received = g_frames[g_frameOf.at(packet->GetUid())].received[node];
    if (received < 0)
    {
        received = Now();
    }
}
} // namespace

int
main(int argc, char** argv)
{
    std::string positions, offers, out;
    double exponent = 3.0, loss0 = 40.052, sensitivity = -85.0;
    uint32_t seed = 1;
    CommandLine cmd;
    cmd.AddValue("positions", "file of nodes", positions);
    cmd.AddValue("offers", "file of frames", offers);
    cmd.AddValue("out", "file of results", out);
    cmd.AddValue("exponent", "of the path loss", exponent);
    cmd.AddValue("loss0", "dB at 1 m", loss0);
    cmd.AddValue("sensitivity", "dBm", sensitivity);
    cmd.AddValue("seed", "run number", seed);
    cmd.Parse(argc, argv);
    RngSeedManager::SetRun(seed);

    auto places = CreateObject<ListPositionAllocator>();
    uint32_t count = 0;
    double x, y, z;
    std::ifstream nodeFile(positions);
    for (char c; nodeFile >> x >> c >> y >> c >> z; count++)
    {
        places->Add(Vector(x, y, z));
    }
    NodeContainer nodes;
    nodes.Create(count);
    MobilityHelper mobility;
    mobility.SetPositionAllocator(places);
    mobility.Install(nodes);

    auto channel = CreateObject<SingleModelSpectrumChannel>();
    auto loss = CreateObject<LogDistancePropagationLossModel>();
    loss->SetPathLossExponent(exponent);
    loss->SetReference(1.0, loss0);
    channel->AddPropagationLossModel(loss);
    channel->SetPropagationDelayModel(CreateObject<ConstantSpeedPropagationDelayModel>());
    LrWpanHelper helper;
    helper.SetChannel(channel);
    auto devices = helper.Install(nodes);
    helper.CreateAssociatedPan(devices, 1);
    g_queued.resize(count);
    for (uint32_t i = 0; i < count; i++)
    {
        auto device = DynamicCast<LrWpanNetDevice>(devices.Get(i));
        g_devices.push_back(device);
        device->GetPhy()->SetRxSensitivity(sensitivity);
        device->GetPhy()->TraceConnectWithoutContext("PhyTxBegin", MakeCallback(&TxBegin));
        device->GetMac()->SetMcpsDataConfirmCallback(MakeBoundCallback(&Confirm, int64_t(i)));
        device->GetMac()->SetMcpsDataIndicationCallback(MakeBoundCallback(&Indication, int64_t(i)));
    }

    int64_t time, sender, to;
    uint32_t size;
    std::ifstream offerFile(offers);
    for (char c; offerFile >> time >> c >> sender >> c >> to >> c >> size;)
    {
        Frame frame{sender, to, time};
        frame.size = size;
        frame.received.assign(count, -1);
        g_frames.push_back(frame);
    }
    for (size_t i = 0; i < g_frames.size(); i++)
    {
        Simulator::Schedule(NanoSeconds(g_frames[i].offered), &Offer, i);
    }
    Simulator::Stop(NanoSeconds(g_frames.empty() ? 0 : g_frames.back().offered) + Seconds(2));
    std::clock_t begin = std::clock();
    Simulator::Run();
    double cpu = double(std::clock() - begin) / CLOCKS_PER_SEC;
    std::printf("{\"cpu_s\": %.4f, \"events\": %lu, \"frames\": %zu}\n", cpu, (unsigned long)Simulator::GetEventCount(), g_frames.size());

    std::ofstream file(out, std::ios::binary);
    for (const Frame& f : g_frames)
    {
        int64_t head[] = {f.sender, f.to, f.offered, f.start, f.end, f.attempts, f.status};
        file.write(reinterpret_cast<const char*>(head), sizeof head);
        file.write(reinterpret_cast<const char*>(f.received.data()), std::streamsize(8 * f.received.size()));
    }
    Simulator::Destroy();
}
